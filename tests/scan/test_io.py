"""Scans from files: geometry, round trips, and files that must be refused."""

import io
import logging
import zipfile
from dataclasses import replace

import h5py
import numpy as np
import pytest
from discs import CENTRE, COLUMNS, ROWS, discs

from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.scan.hdf5 import opened
from tomo_polysplat.scan.io import load_scan, save_scan
from tomo_polysplat.scan.layout import vector_geometry, volume_geometry
from tomo_polysplat.scan.scan import Scan


def cone_scan(seed=3):
    """A scan with nothing left out: geometry, spectrum, truth, metal and bad rays."""
    random = np.random.default_rng(seed)
    rows, views, columns = 3, 5, 7
    angles = np.linspace(0, 2 * np.pi, views, endpoint=False)
    zero, one = np.zeros(views), np.ones(views)
    source = 10 * np.stack([np.sin(angles), -np.cos(angles), zero])
    across = 0.3 * np.stack([np.cos(angles), np.sin(angles), zero])
    vectors = np.concatenate([source, -source, across, 0.4 * np.stack([zero, zero, one])]).T
    valid = random.random((rows, views, columns)) > 0.2
    return Scan(
        projections=random.random((rows, views, columns)),
        proj_geom=vector_geometry("cone_vec", vectors, (rows, views, columns)),
        vol_geom=volume_geometry(np.array([2, 4, 5]), np.array([-1, 1, -2, 3, -0.5, 0.5])),
        unit="mm",
        spectrum=Spectrum([30.0, 60.0, 90.0], [1, 2, 1], "three lines"),
        truth=random.random((2, 4, 5)),
        metal_mask=random.random((2, 4, 5)) > 0.5,
        truth_energy_kev=61.5,
        name="things",
        valid=valid,
    )


# The rotation axis in the geometry


def test_the_axis_of_the_geometry_is_the_centre(exchange):
    path, _ = exchange()
    for given in (None, 29.0):
        scan = load_scan(path, centre=given)
        geometry, _ = from_astra(scan.proj_geom, scan.vol_geom)
        column = geometry.project_points(np.zeros((1, 3)))[:, 0, 0]
        # Geometry counts from the middle of the first pixel, the centre from its edge.
        np.testing.assert_allclose(column + 0.5, CENTRE if given is None else given, atol=0.15)
        assert scan.notes["centre_estimated"] == (given is None)


def test_projections_agree_with_their_geometry(exchange):
    """A disc's centre of mass moves on the detector as the geometry projects its centre."""
    path, lines = exchange()
    scan = load_scan(path, centre=CENTRE)
    geometry, _ = from_astra(scan.proj_geom, scan.vol_geom)
    mass = np.array([0.05 * 81, 0.1 * 25, 0.2 * 16])
    middles = np.array([[6.0, 3.0, 0], [-9.0, 4.0, 0], [2.0, -11.0, 0]])
    expected = geometry.project_points(np.average(middles, axis=0, weights=mass)[None])[:, 0, 0]
    weights = scan.projections[0]
    measured = (weights * np.arange(COLUMNS)).sum(axis=1) / weights.sum(axis=1)
    # Sampling at pixel centres moves the centre of mass by up to 0.14; a wrong sign or origin by more.
    np.testing.assert_allclose(measured, expected, atol=0.2)


# Data Exchange


def test_data_exchange_counts(exchange):
    path, lines = exchange()
    scan = load_scan(path)
    np.testing.assert_allclose(scan.projections, lines.transpose(1, 0, 2), atol=1e-5)
    assert scan.unit == "pixel" and scan.valid is None and scan.volume_shape == (ROWS, COLUMNS, COLUMNS)
    assert scan.notes["input"] == "counts"


def test_data_exchange_reads_in_blocks(exchange, monkeypatch):
    path, lines = exchange()
    monkeypatch.setattr("tomo_polysplat.scan.counts._BLOCK", 7 * ROWS * COLUMNS)
    np.testing.assert_allclose(load_scan(path).projections, lines.transpose(1, 0, 2), atol=1e-5)


def test_bad_rays_of_a_file_are_reported(exchange, caplog):
    path, _ = exchange()
    with h5py.File(path, "r+") as file:
        file["exchange/data"][4, 0, 10] = 100
        file["exchange/data"][5, 1, 11] = np.nan
    scan = load_scan(path)
    assert sorted(map(tuple, np.argwhere(~scan.valid))) == [(0, 4, 10), (1, 5, 11)]
    assert "2 of 11466 rays are left out (1 not finite, 1 no light)" in caplog.text


@pytest.mark.parametrize("kind", ["attenuation", "transmission"])
def test_what_the_numbers_are_is_stated_or_guessed_aloud(exchange, caplog, kind):
    theta = np.linspace(0, 180, 91)
    lines = discs(np.deg2rad(theta)).transpose(1, 0, 2)
    values = lines if kind == "attenuation" else np.exp(-lines)
    path, _ = exchange(data=values, data_white=None, data_dark=None)
    guessed = load_scan(path)
    assert f"look like {kind}" in caplog.text
    caplog.clear()
    stated = load_scan(path, input=kind)
    assert not caplog.records
    for scan in (guessed, stated):
        np.testing.assert_allclose(scan.projections, lines.transpose(1, 0, 2), atol=1e-6)


def test_counts_without_open_beam_are_refused(exchange):
    path, _ = exchange(data_white=None)
    with pytest.raises(ValueError, match="open-beam"):
        load_scan(path)


def test_missing_or_wrong_angles(exchange, caplog):
    path, _ = exchange(theta=None)
    with pytest.raises(ValueError, match=r"theta=.*degrees.*numpy.linspace\(0, 180, 91, endpoint=False\)"):
        load_scan(path)
    scan = load_scan(path, theta=np.linspace(0, 180, 91))
    assert scan.notes["centre"] == pytest.approx(CENTRE, abs=0.15)
    path, _ = exchange(theta=np.zeros(7))
    with pytest.raises(ValueError, match=r"theta: expected shape \(91,\)"):
        load_scan(path)
    path, _ = exchange(theta=np.linspace(0, np.pi, 91))
    load_scan(path, centre=30.0)
    assert "radians?" in caplog.text


def test_pixel_size(exchange):
    path, _ = exchange()
    scan = load_scan(path, pixel_size=0.25, unit="mm", centre=CENTRE)
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    np.testing.assert_allclose(grid.voxel_size, 0.25)
    np.testing.assert_allclose(np.linalg.norm(geometry.u, axis=1), 0.25)
    with pytest.raises(ValueError, match="pixel_size="):
        load_scan(path, unit="mm")
    with h5py.File(path, "r+") as file:
        resolution = file.create_dataset(
            "measurement/instrument/detection_system/objective/resolution", data=3.7
        )
        resolution.attrs["units"] = "microns"
    scan = load_scan(path)
    assert scan.unit == "um"
    np.testing.assert_allclose(from_astra(scan.proj_geom, scan.vol_geom)[1].voxel_size, 3.7)


# Round trips


@pytest.mark.parametrize("suffix", ["h5", "npz"])
def test_what_is_saved_comes_back(tmp_path, suffix):
    scan, path = cone_scan(), tmp_path / f"things.{suffix}"
    save_scan(scan, path)
    back = load_scan(path)
    for name in ("projections", "valid", "truth", "metal_mask"):
        np.testing.assert_array_equal(getattr(back, name), getattr(scan, name), err_msg=name)
    for name in ("unit", "truth_energy_kev", "name", "spectrum"):
        assert getattr(back, name) == getattr(scan, name), name
    np.testing.assert_array_equal(back.proj_geom["Vectors"], scan.proj_geom["Vectors"])
    assert back.vol_geom == scan.vol_geom
    with pytest.raises(FileExistsError, match="overwrite=True"):
        save_scan(scan, path)
    save_scan(scan, path, overwrite=True)


def test_the_callers_word_goes_before_the_files(tmp_path):
    path = tmp_path / "things.npz"
    save_scan(cone_scan(), path)
    line = Spectrum.monochromatic(50.0)
    coarse = volume_geometry(np.array([1, 2, 2]), np.array([-1, 1, -1, 1, -1, 1]))
    scan = load_scan(path, spectrum=line, vol_geom=coarse)
    assert scan.spectrum == line and scan.volume_shape == (1, 2, 2) and scan.truth is None
    with pytest.raises(ValueError, match="'mm', which the file states"):
        load_scan(path, unit="cm")
    with pytest.raises(ValueError, match="centre: expected None"):
        load_scan(path, centre=3.0)


def test_an_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "things.npz"
    save_scan(cone_scan(), path)
    before = path.read_bytes()

    def stop(file, **arrays):
        file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", stop)
    with pytest.raises(KeyboardInterrupt):
        save_scan(cone_scan(4), path, overwrite=True)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path], "a temporary file was left behind"


# Files that must be refused


@pytest.mark.parametrize("suffix", ["h5", "npz"])
@pytest.mark.parametrize("share", [0.01, 0.3, 0.6, 0.95])
def test_truncated_files_are_refused(tmp_path, suffix, share):
    whole, cut = tmp_path / f"whole.{suffix}", tmp_path / f"cut.{suffix}"
    save_scan(cone_scan(), whole)
    data = whole.read_bytes()
    cut.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ValueError, match="path: expected"):
        load_scan(cut)


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "scan.h5"
    path.write_bytes(b"")
    with pytest.raises(ValueError, match="empty"):
        load_scan(path)
    path.write_text("not a scan at all")
    with pytest.raises(ValueError, match="none of these"):
        load_scan(path)
    with pytest.raises(FileNotFoundError):
        load_scan(tmp_path / "missing.h5")
    np.savez(tmp_path / "other.npz", projections=np.zeros((2, 2, 2)), vol_shape=(2, 2, 2))
    with pytest.raises(ValueError, match="no vectors, vol_window"):
        load_scan(tmp_path / "other.npz")


def test_pickles_are_never_loaded(tmp_path):
    path = tmp_path / "evil.npz"
    np.savez(path, projections=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ValueError, match="never loaded"):
        load_scan(path)


def test_a_header_cannot_ask_for_memory(tmp_path):
    """Sizes are compared with what is stored before anything is allocated."""
    header = io.BytesIO()
    declared = {"descr": "<f4", "fortran_order": False, "shape": (10**6, 10**5, 10)}
    np.lib.format.write_array_header_1_0(header, declared)
    with zipfile.ZipFile(tmp_path / "huge.npz", "w") as archive:
        archive.writestr("projections.npy", header.getvalue() + b"\0" * 64)
    with pytest.raises(ValueError, match="damaged"):
        load_scan(tmp_path / "huge.npz")
    with h5py.File(tmp_path / "huge.h5", "w") as file:
        file.create_dataset("exchange/data", (10**6, 10**4, 10**4), "f4", chunks=(1, 100, 100))
    with pytest.raises(ValueError, match="bytes declared but 0 stored"):
        load_scan(tmp_path / "huge.h5")


def test_a_broken_geometry_group_is_refused(tmp_path):
    path = tmp_path / "things.h5"
    save_scan(cone_scan(), path)
    with h5py.File(path, "r+") as file:
        file["polysplat/geometry"].attrs["astra_type"] = "spiral"
    with pytest.raises(ValueError, match="astra_type.*spiral"):
        load_scan(path)
    with h5py.File(path, "r+") as file:
        del file["polysplat/geometry/vectors"]
        file["polysplat/geometry"].attrs["astra_type"] = "cone_vec"
    with pytest.raises(ValueError, match="dataset vectors"):
        load_scan(path)


def test_loading_is_quiet_when_nothing_is_wrong(exchange, caplog):
    path, _ = exchange()
    with caplog.at_level(logging.WARNING):
        load_scan(path)
    assert not caplog.records


def test_an_error_of_what_is_done_with_a_file_stays_what_it_is(tmp_path):
    save_scan(cone_scan(), tmp_path / "scan.h5")
    for error in (KeyError("proj_geom"), RuntimeError("no thread"), OSError(28, "No space left on device")):
        with pytest.raises(type(error)) as raised, opened(tmp_path / "scan.h5"):
            raise error
        assert raised.value is error
    with pytest.raises(ValueError, match="readable HDF5"), opened(tmp_path / "scan.h5") as file:
        file["nothing here"]


def test_a_scan_is_checked_when_it_is_made():
    scan = cone_scan()
    assert scan == scan and scan != replace(scan)
    with pytest.raises(ValueError, match="unit: expected one of"):
        replace(scan, unit="inch")
    with pytest.raises(ValueError, match="projections.*as proj_geom says"):
        replace(scan, projections=scan.projections[:, :-1], valid=None)


@pytest.mark.parametrize("suffix", ["h5", "npz"])
def test_a_volume_that_somebody_chose_is_that_of_a_part_too(tmp_path, suffix):
    path = tmp_path / f"things.{suffix}"
    save_scan(cone_scan(), path)
    chosen = volume_geometry(np.array([6, 4, 5]), np.array([-1.0, 4.0, 0.5, 4.5, -3.0, 3.0]))
    for part in ({"views": 2}, {"rows": (1, 3)}, {"columns": (1, 5)}, {"binning": 2}):
        assert load_scan(path, vol_geom=chosen, **part).vol_geom == chosen, part
    # One that is not about the z axis stays where it is, of coarser voxels.
    save_scan(replace(cone_scan(), vol_geom=chosen, truth=None, metal_mask=None), path, overwrite=True)
    grid = from_astra(cone_scan().proj_geom, load_scan(path, binning=2).vol_geom)[1]
    np.testing.assert_allclose([grid.lower[:2], grid.upper[:2]], [[-1.0, 0.5], [4.0, 4.5]])
    np.testing.assert_allclose(grid.voxel_size[:2], [5 / 2, 4 / 2])


def test_a_volume_as_astra_itself_describes_it_is_saved(tmp_path):
    """ASTRA gives a volume's window under another word than it takes it; without one voxels have edges of 1."""
    scan = cone_scan()
    plain = {key: scan.vol_geom[key] for key in ("GridColCount", "GridRowCount", "GridSliceCount")}
    for number, told in enumerate((plain | {"options": scan.vol_geom["option"]}, plain)):
        path = tmp_path / f"{number}.npz"
        save_scan(replace(scan, vol_geom=told), path)
        expected, back = (from_astra(scan.proj_geom, geom)[1] for geom in (told, load_scan(path).vol_geom))
        np.testing.assert_array_equal([back.lower, back.upper], [expected.lower, expected.upper])
