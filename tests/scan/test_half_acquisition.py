"""Detectors beside the axis: the volume is as wide as a whole turn sees, where the object is."""

import h5py
import numpy as np
import pytest

import tomo_polysplat as tps

COLUMNS, ROWS, AXIS = 24, 2, 4.5


def _lines(radius, degrees, axis=AXIS, aside=1.5, magnification=1.0):
    """(views, rows, columns) of a cylinder of 0.05 / pixel whose middle goes about the axis."""
    angles = np.deg2rad(degrees)[:, None]
    at = np.arange(COLUMNS) + 0.5 - axis - aside * np.cos(angles)
    chord = 2 * np.sqrt(np.maximum((magnification * radius) ** 2 - at**2, 0)) / magnification
    return np.repeat(0.05 * chord[:, None], ROWS, axis=1)


def _file(path, lines, degrees):
    with h5py.File(path, "w") as file:
        file["exchange/data"] = lines.astype(np.float32)
        file["exchange/data"].attrs["input"] = "attenuation"
        file["exchange/theta"] = degrees
    return path


@pytest.mark.parametrize(
    "radius, arc, axis, across",
    [
        (17.0, 360, AXIS, 39),
        (17.0, 360, COLUMNS - AXIS, 39),
        (9.0, 360, AXIS, COLUMNS),  # nothing lies beside the usual volume
        (17.0, 180, AXIS, COLUMNS),  # the other side was never seen
        (17.0, 360, COLUMNS / 2, COLUMNS),  # cut off at both ends: local tomography
    ],
)
def test_a_half_acquisition_gets_a_volume_as_wide_as_it_sees(tmp_path, radius, arc, axis, across):
    degrees = np.linspace(0, arc, 41, endpoint=False)
    scan = tps.load_scan(_file(tmp_path / "scan.h5", _lines(radius, degrees, axis), degrees), centre=axis)
    assert scan.volume_shape == (ROWS, across, across)
    assert scan.vol_geom["option"]["WindowMaxX"] == across / 2 == -scan.vol_geom["option"]["WindowMinY"]


def test_noise_and_a_few_bad_rays_are_no_object(tmp_path):
    degrees = np.linspace(0, 360, 60, endpoint=False)
    lines = _lines(9.0, degrees) + np.random.default_rng(1).normal(0, 0.1, (60, ROWS, COLUMNS))
    lines[3, :, -3:], lines[7:9, 0, -12:] = np.nan, 30.0
    scan = tps.load_scan(_file(tmp_path / "scan.h5", lines, degrees), centre=AXIS)
    assert scan.volume_shape[1:] == (COLUMNS, COLUMNS)


def test_a_volume_that_is_told_stays_and_parts_are_widened(tmp_path):
    degrees = np.linspace(0, 360, 41, endpoint=False)
    path = _file(tmp_path / "scan.h5", _lines(17.0, degrees), degrees)
    usual = tps.load_scan(
        path,
        centre=AXIS,
        vol_geom=tps.parallel_geometry(pixel=1, detector=(ROWS, COLUMNS), degrees=degrees)[1],
    )
    assert usual.volume_shape == (ROWS, COLUMNS, COLUMNS)
    assert tps.load_scan(path, centre=AXIS, rows=(0, 1)).volume_shape == (1, 39, 39)
    assert tps.load_scan(path, centre=AXIS, binning=2).volume_shape == (1, 20, 20)
    # What was widened is saved with its volume, and read again as it is.
    tps.save_scan(tps.load_scan(path, centre=AXIS), tmp_path / "again.h5")
    assert tps.load_scan(tmp_path / "again.h5").volume_shape == (ROWS, 39, 39)


def test_a_panel_beside_the_axis_of_a_cone_beam(tmp_path):
    degrees = np.linspace(0, 360, 41, endpoint=False)
    lines = _lines(17.0, degrees, magnification=1.0, aside=0.0)
    np.savez(tmp_path / "stack.npz", projections=lines.astype(np.float32), degrees=degrees)
    told = {"source_object": 900.0, "source_detector": 1000.0, "pixel": 1.0, "input": "attenuation"}
    scan = tps.load_scan(tmp_path / "stack.npz", scanner=told | {"offset": (COLUMNS / 2 - AXIS, 0.0)})
    assert scan.volume_shape == (ROWS, 39, 39)
    assert scan.vol_geom["option"]["WindowMaxX"] == pytest.approx(0.9 * 19.5)


def test_counts_that_stay_in_their_file_are_widened_by_some_of_their_views(tmp_path, monkeypatch):
    from tomo_polysplat.scan import data_exchange

    monkeypatch.setattr(data_exchange, "_STAYS", 1)
    degrees = np.linspace(0, 360, 400, endpoint=False)
    path = tmp_path / "scan.h5"
    with h5py.File(path, "w") as file:
        file["exchange/data"] = np.round(20000 * np.exp(-_lines(17.0, degrees))).astype(np.uint16)
        file["exchange/data_white"] = np.full((1, ROWS, COLUMNS), 20000, np.uint16)
        file["exchange/theta"] = degrees
    scan = tps.load_scan(path, centre=AXIS)
    assert isinstance(scan.projections, tps.Counts) and scan.volume_shape == (ROWS, 39, 39)
