"""Part of an HDF5 scan: what the whole scan holds there, without reading the rest."""

import h5py
import numpy as np
import pytest
from discs import CENTRE, COLUMNS, ROWS

import tomo_polysplat as tps
from tomo_polysplat.scan.hdf5_array import StoredArray
from tomo_polysplat.scan.readers.part import Part
from tomo_polysplat.scan.readers.scan_part import scan_part

PARTS = [
    {"views": 3},
    {"views": (7, 80, 2), "columns": (5, 41)},
    {"rows": (1, ROWS), "views": (40, 91)},
    {"rows": (0, 2), "columns": (3, 38), "views": 4, "binning": 2},
    {"views": (90, 91)},
]


@pytest.fixture
def boxes(monkeypatch):
    """What of /exchange/data is read: the number of values, each time."""
    read, taken = StoredArray._read, []

    def noted(self, box):
        if self.name == "/exchange/data":
            taken.append(int(np.prod([len(part) for part in box])))
        return read(self, box)

    monkeypatch.setattr(StoredArray, "_read", noted)
    monkeypatch.setattr("tomo_polysplat.scan.dxchange_host.real_dxchange", lambda: None)
    return taken


def require_equal(part, expected):
    np.testing.assert_allclose(part.projections, expected.projections, atol=1e-6)
    np.testing.assert_allclose(part.proj_geom["Vectors"], expected.proj_geom["Vectors"], atol=1e-9)
    assert part.vol_geom == expected.vol_geom and part.unit == expected.unit
    if part.valid is None:
        assert expected.valid is None or expected.valid.all()
    else:
        np.testing.assert_array_equal(part.valid, expected.valid)
    for name in ("truth", "metal_mask"):
        np.testing.assert_array_equal(getattr(part, name), getattr(expected, name))
    filters = part.filter_map, expected.filter_map
    assert (filters[0] is None) == (filters[1] is None)
    if filters[0] is not None:
        np.testing.assert_array_equal(filters[0][1], filters[1][1])


@pytest.mark.parametrize("part", PARTS, ids=str)
def test_counts_of_a_parallel_beam(part, exchange, boxes):
    path, _ = exchange()
    with h5py.File(path, "r+") as file:
        file["exchange/data"][8, 1, 10] = 100
        file["exchange/data_white"][:, 0, 20] = 100
    known = {"centre": CENTRE, "pixel_size": 0.1, "unit": "mm"}
    whole = tps.load_scan(path, **known)
    boxes.clear()
    scan = tps.load_scan(path, **known, **part)
    require_equal(scan, scan_part(whole, Part(**part)))
    binned = part.get("binning", 1) ** 2
    assert scan.projections.size * binned <= sum(boxes) <= 1.1 * scan.projections.size * binned


def test_an_axis_that_is_looked_for_needs_whole_rows(exchange, boxes):
    path, _ = exchange()
    scan = tps.load_scan(path, rows=(1, 2), columns=(4, 40))
    assert scan.notes["centre"] == pytest.approx(CENTRE, abs=0.15)
    assert scan.projections.shape == (1, 91, 36) and sum(boxes) == 91 * COLUMNS
    np.testing.assert_array_equal(scan.projections, tps.load_scan(path).projections[1:2, :, 4:40])


@pytest.mark.parametrize("part", [{"views": 2}, {"rows": (2, 9), "columns": (1, 8), "views": 3}], ids=str)
def test_a_scan_of_our_own(part, tmp_path, boxes):
    """With bad rays, a truth, which goes with its volume, and a filter of each pixel."""
    scan = tps.simulate_scan("pins", 9, 12)
    scan.valid = np.random.default_rng(0).random(scan.projections.shape) > 0.1
    scan.projections[~scan.valid] = 0
    scan.filter_map = ("Al", np.linspace(0.1, 0.2, scan.rows * scan.columns).reshape(scan.rows, -1), 2.7)
    tps.save_scan(scan, tmp_path / "scan.h5")
    whole = tps.load_scan(tmp_path / "scan.h5")
    boxes.clear()
    read = tps.load_scan(tmp_path / "scan.h5", **part)
    require_equal(read, scan_part(whole, Part(**part)))
    assert (read.truth is None) == ("rows" in part) and sum(boxes) == read.projections.size


def test_a_filter_of_other_pixels_is_refused(tmp_path):
    scan = tps.simulate_scan("pins", 9, 12)
    scan.filter_map = ("Al", np.full((scan.rows, scan.columns), 0.1), 2.7)
    tps.save_scan(scan, tmp_path / "scan.h5")
    with h5py.File(tmp_path / "scan.h5", "r+") as file:
        attributes = dict(file["polysplat/filter_thickness"].attrs)
        del file["polysplat/filter_thickness"]
        file["polysplat/filter_thickness"] = np.full((2, 3), 0.1)
        file["polysplat/filter_thickness"].attrs.update(attributes)
    with pytest.raises(ValueError, match="filter_thickness: expected shape"):
        tps.load_scan(tmp_path / "scan.h5", views=2)
