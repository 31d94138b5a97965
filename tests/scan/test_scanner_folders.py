"""Every kind of scanner's folder gives the volume of the package's own file."""

import sys
from functools import cache
from unittest import mock

import numpy as np
import pytest
import SimpleITK
from folders import error_db, marked, require_the_same_volume

import tomo_polysplat as tps
from tomo_polysplat.cli import main
from tomo_polysplat.simulate.folders import write
from tomo_polysplat.simulate.folders.__main__ import main as write_one
from tomo_polysplat.simulate.folders.scene import MARKER
from tomo_polysplat.simulate.folders.write import KINDS, scan_for, write_folder


@pytest.fixture(scope="module", autouse=True)
def simulated_once():
    """Most kinds hold the same scan, which nobody changes."""
    with mock.patch.object(write, "marked_scan", cache(write.marked_scan)):
        yield


@pytest.fixture(scope="module", params=KINDS)
def read(request, tmp_path_factory):
    """A kind of folder, its scan as our own, and as it is read; what reads it leaves it as it is."""
    folder = tmp_path_factory.mktemp("scans") / "folder"
    return request.param, write_folder(request.param, folder), tps.load_scan(folder)


def test_a_folder_gives_the_volume_of_our_own_file(read, tmp_path):
    kind, own, scan = read
    tps.save_scan(own, tmp_path / "own.h5")
    require_the_same_volume(scan, tps.load_scan(tmp_path / "own.h5"))
    if kind in ("tiffs", "skyscan", "nikon"):
        # What the folder tells of the tube makes the spectrum that the scan was made with.
        assert scan.spectrum.effective_energy == pytest.approx(own.spectrum.effective_energy)
        assert any("flat panel" in guess for guess in scan.notes["scanner"]["guessed"])


@pytest.mark.parametrize("kind", KINDS)
def test_a_scan_of_another_size_gives_the_volume_of_our_own_file(kind, tmp_path):
    """Even rows, so that no pixel is in the middle, odd columns, fewer views, and another noise."""
    size = {"views": 36, "rows": 38, "columns": 43, "seed": 1}
    own = write_folder(kind, tmp_path / "folder", scan_for(kind, **size))
    scan = tps.load_scan(tmp_path / "folder")
    assert scan.vol_geom["GridSliceCount"] == 38 and scan.vol_geom["GridColCount"] == 43
    require_the_same_volume(scan, own)


def test_another_library_opens_the_volume_of_a_folder(read, tmp_path):
    """Voxel size, unit and orientation: the marker lies off every axis, where the simulated one does."""
    _, own, scan = read
    tps.baselines.fdk(scan).save(tmp_path / "volume.mha")
    image = SimpleITK.ReadImage(str(tmp_path / "volume.mha"))
    side = 1.6 * 100 / 250  # of a pixel, brought down to the axis, in mm
    np.testing.assert_allclose(image.GetSpacing(), [side] * 3, rtol=1e-6)
    values = SimpleITK.GetArrayFromImage(image)
    found = np.unravel_index(np.argmax(values), values.shape)[::-1]
    place = image.TransformIndexToPhysicalPoint([int(index) for index in found])
    np.testing.assert_allclose(place, 10 * np.array(MARKER), atol=1.6)  # its radius
    # In 1/mm: like that of the own file, which is in 1/cm.
    expected = tps.baselines.fdk(own)
    assert own.unit == "cm" and expected.unit == "cm"
    assert abs(error_db(10 * values, own.truth) - error_db(expected.volume, own.truth)) < 0.3


def test_the_size_of_a_folder_s_scan_can_be_told(tmp_path, monkeypatch):
    sizes = ["--views", "5", "--rows", "8", "--columns", "11", "--seed", "3"]
    monkeypatch.setattr(sys, "argv", ["folders", "npz", str(tmp_path / "folder"), *sizes])
    assert write_one() == 0
    assert tps.load_scan(tmp_path / "folder").projections.shape == (8, 5, 11)


def test_the_folder_above_that_of_the_scan(tmp_path):
    """As scanners' users keep them: the pictures in one folder, the reconstruction in another beside it."""
    own = write_folder("skyscan", tmp_path / "tooth" / "proj", marked())
    write_folder("skyscan", tmp_path / "tooth" / "tooth_rec", marked())
    (tmp_path / "tooth" / "tooth_rec").rename(tmp_path / "tooth" / "rec")
    scan = tps.load_scan(tmp_path / "tooth")
    assert scan.projections.shape == own.projections.shape
    assert "what is read is proj in tooth" in scan.notes["scanner"]["guessed"]
    write_folder("nikon", tmp_path / "tooth" / "again", marked())
    with pytest.raises(ValueError, match="one scan in the folder, got again, proj; name one"):
        tps.load_scan(tmp_path / "tooth")


def test_a_folder_is_not_written_over(tmp_path):
    (tmp_path / "mine.txt").write_text("keep me")
    with pytest.raises(FileExistsError, match="a new or empty folder"):
        write_folder("tiffs", tmp_path, marked())


def test_two_commands_from_a_folder_to_a_file(tmp_path, monkeypatch, capsys, caplog):
    write_folder("tiffs", tmp_path / "folder", marked())
    monkeypatch.chdir(tmp_path)
    assert main(["import", "folder", "-o", "scan.h5", "--views", "2"]) == 0
    assert "wrote scan.h5" in capsys.readouterr().out and "flat panel" in caplog.text
    scan = tps.load_scan(tmp_path / "scan.h5")
    assert scan.views == 24 and scan.unit == "mm" and scan.notes["scanner"]["keys"] == {"operator": "nobody"}


def test_the_tube_s_options_mean_the_same_as_in_the_scanner_s_text(tmp_path, capsys):
    """A flat panel, unless another detector is named; the log's own filter where only a voltage is told."""
    own = write_folder("skyscan", tmp_path / "folder", marked())
    energies = []
    for options in (["--kvp", "90"], ["--kvp", "90", "--filter", "Al 1mm"], ["--detector", "counting"]):
        output = str(tmp_path / "scan.npz")
        assert main(["import", str(tmp_path / "folder"), "-o", output, "--overwrite", *options]) == 0
        energies.append(tps.load_scan(output).spectrum.effective_energy)
    assert energies[:2] == pytest.approx([own.spectrum.effective_energy] * 2)
    assert energies[2] < own.spectrum.effective_energy - 2
    assert "No filter was given" not in capsys.readouterr().err


@pytest.mark.parametrize("kind", KINDS)
def test_what_a_mac_leaves_on_a_disk_of_another_system(kind, tmp_path):
    """Beside each file one of the same name after ``._``, which is none of its kind."""
    write_folder(kind, tmp_path / "folder", marked())
    expected = tps.load_scan(tmp_path / "folder")
    for file in list((tmp_path / "folder").rglob("*")):
        if file.is_file():
            (file.parent / f"._{file.name}").write_bytes(b"\0\5\26\7\0\2\0\0Mac OS X" + bytes(16))
    (tmp_path / "folder" / ".DS_Store").write_bytes(bytes(8))
    np.testing.assert_array_equal(tps.load_scan(tmp_path / "folder").projections, expected.projections)
