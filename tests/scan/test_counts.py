"""Counts that stay in their file: what is made of them is what reading all of them makes, to the bit."""

import h5py
import numpy as np
import pytest
from discs import CENTRE, COLUMNS, ROWS, discs

import tomo_polysplat as tps
from tomo_polysplat.scan import data_exchange
from tomo_polysplat.scan.check import check_scan
from tomo_polysplat.scan.counts import Counts
from tomo_polysplat.scan.mending import mend_scan
from tomo_polysplat.scan.usable import usable_rays

KNOWN = {"centre": CENTRE, "pixel_size": 0.1, "unit": "mm"}
KEYS = [
    1,
    (slice(None), 3),
    (slice(1, None), slice(5, 80, 7), slice(10, 20)),
    (slice(None, None, -1), slice(40, 2, -3)),
    np.array([0, 1]),
    (slice(None), np.array([7, 3, 3, 50])),
    (np.array([0, 1])[:, None], np.array([[5, 6, 9]])),
    (np.array([0, 1]), np.array([9, 4]), 8),
    (slice(None), np.arange(91) % 9 == 0),
    (..., 4),
    (-1, -2, -3),
]


def counted(seed=1):
    """Counts (views, rows, columns) of the discs with every kind of bad ray, open-beam and dark images."""
    rng = np.random.default_rng(seed)
    lines = discs(np.deg2rad(np.linspace(0, 180, 91))).transpose(1, 0, 2)
    dark = rng.integers(90, 110, (2, ROWS, COLUMNS)).astype(np.uint16)
    white = rng.integers(39900, 40100, (3, ROWS, COLUMNS)).astype(np.uint16)
    counts = (100 + rng.poisson(40000 * np.exp(-lines))).astype(np.uint16)
    white[:, 1, 30] = 0  # dead
    counts[:, 0, 17] = 80  # darker than no light
    counts[11, 1, 5:9] = 65535  # saturated
    counts[40:43, :, 22:29] = 118  # hardly any light, and none
    counts[40:43, 1, 25] = 50
    return counts, white, dark


@pytest.fixture
def both(exchange, monkeypatch):
    """The scan of a file read as a whole, and left where it is."""

    def load(**changes):
        counts, white, dark = counted()
        path, _ = exchange(**{"data": counts, "data_white": white, "data_dark": dark} | changes)
        known = {} if "theta" in changes else KNOWN
        whole = tps.load_scan(path, **known)
        monkeypatch.setattr(data_exchange, "_STAYS", 1)
        return whole, tps.load_scan(path, **known)

    return load


def test_what_is_made_is_what_is_read(both):
    whole, stays = both()
    assert isinstance(stays.projections, Counts) and isinstance(whole.projections, np.ndarray)
    assert whole.notes["rays"] == stays.notes["rays"] and min(whole.notes["rays"].values()) == 0
    assert sum(count > 0 for count in whole.notes["rays"].values()) == 3
    for name in ("projections", "valid", "usable"):
        made, read = np.asarray(getattr(stays, name)), getattr(whole, name)
        assert made.dtype == read.dtype
        np.testing.assert_array_equal(made, read)
    np.testing.assert_array_equal(2 * stays.projections, 2 * whole.projections)


@pytest.mark.parametrize("key", KEYS, ids=str)
def test_looked_at_as_an_array_is(both, key):
    whole, stays = both()
    made, read = stays.projections[key], whole.projections[key]
    assert made.shape == read.shape
    np.testing.assert_array_equal(made, read)
    np.testing.assert_array_equal(stays.valid[key], whole.valid[key])


def test_the_rays_of_a_fit_are_the_same(both, monkeypatch):
    """Also where a block holds few views, and a part of one few rows."""
    whole, stays = both()
    expected, counts, _ = usable_rays(whole.projections, whole.proj_geom, whole.usable)
    for block, part in ((1 << 24, 1 << 18), (7 * ROWS * COLUMNS, COLUMNS)):
        monkeypatch.setattr("tomo_polysplat.scan.counts._BLOCK", block)
        monkeypatch.setattr("tomo_polysplat.scan.counts._PART", part)
        values, found, _ = usable_rays(stays.projections, stays.proj_geom, stays.usable)
        assert found == counts and counts["rays_opaque"] == 3
        np.testing.assert_array_equal(values, expected)


def test_a_mask_comes_on_top(both):
    whole, stays = both()
    mask = np.ones(whole.projections.shape, bool)
    mask[:, 5] = False
    expected, _, _ = usable_rays(whole.projections, whole.proj_geom, whole.usable & mask)
    values, _, _ = usable_rays(stays.projections, stays.proj_geom, mask)
    np.testing.assert_array_equal(values, expected)
    values, _, _ = usable_rays(stays.projections, stays.proj_geom, stays.usable & mask)
    np.testing.assert_array_equal(values, expected)


def test_probes_answer_the_same(both):
    whole, stays = both()
    assert [finding.text for finding in check_scan(stays)] == [finding.text for finding in check_scan(whole)]
    assert mend_scan(stays)[1] == mend_scan(whole)[1]


def test_the_axis_is_found_where_it_was(both):
    whole, stays = both(theta=np.linspace(0, 180, 91))
    assert whole.notes["centre_estimated"] and stays.notes["centre"] == whole.notes["centre"]


@pytest.mark.parametrize(
    "part", [{"views": (7, 80, 2), "rows": (1, ROWS), "columns": (5, 41)}, {"binning": 2}], ids=str
)
def test_a_part_stays_as_well(exchange, monkeypatch, part):
    counts, white, dark = counted()
    path, _ = exchange(data=counts, data_white=white, data_dark=dark)
    whole = tps.load_scan(path, **KNOWN, **part)
    monkeypatch.setattr(data_exchange, "_STAYS", 1)
    stays = tps.load_scan(path, **KNOWN, **part)
    assert isinstance(stays.projections, Counts) == ("binning" not in part)
    np.testing.assert_array_equal(np.asarray(stays.projections), whole.projections)
    np.testing.assert_array_equal(np.asarray(stays.valid), whole.valid)
    assert stays.vol_geom == whole.vol_geom


def test_a_saved_scan_is_the_same(both, tmp_path):
    whole, stays = both()
    for ending in ("h5", "npz"):
        tps.save_scan(stays, tmp_path / f"copy.{ending}")
        copy = tps.load_scan(tmp_path / f"copy.{ending}")
        np.testing.assert_array_equal(copy.projections, whole.projections)
        np.testing.assert_array_equal(copy.valid, whole.valid)


def test_a_file_that_changes_is_refused(exchange, monkeypatch):
    monkeypatch.setattr(data_exchange, "_STAYS", 1)
    path, _ = exchange()
    scan = tps.load_scan(path, **KNOWN)
    with h5py.File(path, "r+") as file:
        file["exchange/more"] = np.zeros(1000)
    with pytest.raises(ValueError, match="load the scan again"):
        scan.projections[0]


def test_an_array_of_counts(tmp_path):
    """A camera's file of plain numbers, as a map."""
    counts, white, dark = counted()
    counts.tofile(tmp_path / "camera.raw")
    mapped = np.memmap(tmp_path / "camera.raw", np.uint16, "r", shape=counts.shape)
    made = tps.Counts.of(mapped, white, dark)
    light = white.mean(axis=0) - dark.mean(axis=0)
    with np.errstate(all="ignore"):
        lines = -np.log((counts - dark.mean(axis=0)) / light).transpose(1, 0, 2)
    good = np.asarray(made.marks)
    assert 0.9 < good.mean() < 1
    np.testing.assert_allclose(np.asarray(made)[good], lines[good], rtol=1e-6)
    with pytest.raises(ValueError, match="more light"):
        tps.Counts.of(mapped, dark, white)
    with pytest.raises(ValueError, match="counts: expected some views"):
        tps.Counts.of(counts[:0], white, dark)


def test_chunks_that_are_unpacked_many_times_are_told(exchange, monkeypatch, caplog):
    """One view a chunk is read once, and so is anything that is read in one block."""
    counts, white, dark = counted()
    path, _ = exchange(data=None, data_white=white, data_dark=dark)
    for views, block, told in ((91, 4, True), (91, 91, False), (1, 4, False)):
        with h5py.File(path, "r+") as file:
            file.pop("exchange/data", None)
            file.create_dataset("exchange/data", data=counts, chunks=(views, 1, 16), compression="gzip")
        monkeypatch.setattr("tomo_polysplat.scan.counts._BLOCK", block * ROWS * COLUMNS)
        caplog.clear()
        tps.load_scan(path, **KNOWN)
        assert (f"h5repack -l /exchange/data:CHUNK=1x{ROWS}x{COLUMNS} {path}" in caplog.text) == told
