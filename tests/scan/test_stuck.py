"""Pixels that never change are found; air, opaque rays, and what turns about the axis are not taken for them."""

import logging

import numpy as np
import pytest

import tomo_polysplat as tps
from tomo_polysplat.scan.stuck import stuck_pixels

VIEWS, ROWS, COLUMNS = 11, 3, 23


def scan(noise=0.01, seed=0):
    """(views, rows, columns) of a disc with a pin that turns."""
    place = np.arange(COLUMNS) - COLUMNS // 2
    pin = 7 * np.sin(2 * np.pi * np.arange(VIEWS) / VIEWS)[:, None]
    line = 0.2 * np.sqrt(np.maximum(81 - place**2, 0)) + np.exp(-0.5 * (place - pin) ** 2)
    values = np.repeat(line[:, None], ROWS, axis=1)
    values += noise * np.random.default_rng(seed).standard_normal(values.shape)
    return values.astype(np.float32)


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("columns", [[5], [9, 10], [3, 18]])
def test_what_never_changes_is_found(columns, noise):
    values = scan(noise)
    values[:, 1, columns] = [0.35, -0.7][: len(columns)]
    wanted = np.zeros((ROWS, COLUMNS), bool)
    wanted[1, columns] = True
    np.testing.assert_array_equal(stuck_pixels(values), wanted)


@pytest.mark.parametrize("value", [0.0, 9.0, 0.8])
@pytest.mark.parametrize("rows", [slice(None), slice(4, 7)], ids=["all rows", "some"])
@pytest.mark.parametrize("columns", [slice(9, 15), slice(None)], ids=["some columns", "all"])
def test_areas_and_gaps_between_tiles_are_found(rows, columns, value):
    values = np.repeat(scan(), 4, axis=1)
    values += 0.01 * np.random.default_rng(1).standard_normal(values.shape).astype(np.float32)
    wanted = np.zeros(values.shape[1:], bool)
    wanted[rows, columns] = True
    values[:, wanted] = value
    np.testing.assert_array_equal(stuck_pixels(values), wanted & ~wanted.all())
    masked = np.maximum(np.repeat(scan(), 4, axis=1), 0)
    assert not stuck_pixels(masked).any(), "air that a program set to 0"


def test_what_may_be_constant_is_left():
    assert not stuck_pixels(scan(0.0)).any(), "a disc about the axis, without noise, and air"
    assert not stuck_pixels(np.ones((VIEWS, ROWS, COLUMNS), np.float32)).any(), "all rays alike"
    opaque, missing = scan(), scan()
    opaque[:, :, 11] = 9.0
    opaque[:, :, [10, 12]] -= np.log(0.7)  # Its edges cover 0.3 of a pixel.
    assert not stuck_pixels(opaque).any(), "a wire on the axis through which no light passes"
    assert not stuck_pixels(opaque, axis=11.0).any() and not stuck_pixels(opaque, axis=12.5).any()
    missing[:, :, 11] = np.nan
    assert not stuck_pixels(missing).any()
    assert not stuck_pixels(np.repeat(scan()[:1], 7, axis=0)).any(), "few views"


def test_a_column_without_light_beside_the_axis_is_dead():
    """Its logarithm is far above all that works: one photon of a million. A dark ring shows on both sides."""
    values = scan()
    values[:, :, 3] = 14.0
    wanted = np.zeros((ROWS, COLUMNS), bool)
    wanted[:, 3] = True
    np.testing.assert_array_equal(stuck_pixels(values, axis=11.0), wanted)
    values[:, :, 19] = 14.0
    values[:, :, [4, 18]] += 0.4  # The rest of the ring, whose edges lie within a pixel.
    assert not stuck_pixels(values, axis=11.0).any()


@pytest.mark.parametrize("columns", [[11], [10, 11], [13]])
def test_a_column_without_light_on_the_axis_that_has_no_edges_is_dead(columns):
    values = scan()
    values[:, :, columns] = 14.0
    wanted = np.zeros((ROWS, COLUMNS), bool)
    wanted[:, columns] = True
    np.testing.assert_array_equal(stuck_pixels(values, axis=11.0), wanted)


def test_a_pixel_without_light_in_air_is_dead_whatever_is_dead_elsewhere():
    """Nothing changes beside it. An opaque ring shows on the other side at the same height, dead pixels hardly."""
    random = np.random.default_rng(3)
    values = np.repeat(scan(), 5, axis=1)
    values += 0.01 * random.standard_normal(values.shape).astype(np.float32)
    wanted = np.zeros(values.shape[1:], bool)
    wanted[[2, 12], [1, 21]] = True
    values[:, wanted] = 14.0
    np.testing.assert_array_equal(stuck_pixels(values, axis=11.0), wanted)
    values[:, [2, 12], [21, 1]] = 14.0  # Now each shows on both sides.
    assert not stuck_pixels(values, axis=11.0).any()


def test_what_lies_between_air_and_where_things_change_is_left():
    """Without noise the rim of a disc is constant, beside air that is 0, until something turns in its shadow."""
    values = scan(0.0)
    values[:, :, :4] = values[:, :, -4:] = 0.0
    values[:, :, [4, 5, 17, 18]] = [0.5, 0.6, 0.6, 0.5]
    assert not stuck_pixels(values).any()


def test_counts_of_few_values_are_left():
    """Air of 200 counts and next to no noise: most pixels show 200 in every view."""
    random = np.random.default_rng(1)
    counts = np.round(200 + 0.12 * random.standard_normal((12, 40, 90)))
    values = (-np.log(counts / 201)).astype(np.float32)
    values[:, :, 40:50] += 2 + random.random((12, 40, 10)).astype(np.float32)
    assert not stuck_pixels(values).any()


@pytest.mark.parametrize("photons", [10, 100, 1000])
def test_a_gap_of_the_value_of_air_is_found_among_counts(photons):
    """Counts of air come back as well, but not in the next view; rays that a mask leaves out tell nothing."""
    random = np.random.default_rng(2)
    views, columns = 40, 31
    place = np.arange(columns) - 15 - 3 * np.sin(2 * np.pi * np.arange(views) / views)[:, None]
    light = np.exp(-0.25 * np.sqrt(np.maximum(81 - place**2, 0)))
    counts = random.poisson(photons * np.repeat(light[:, None], 5, axis=1))
    values = -np.log(np.maximum(counts, 0.5) / photons).astype(np.float32)
    assert not stuck_pixels(values).any()
    values[:, :, 12:15] = 0.0
    values[random.random(values.shape) < 0.1] = np.nan
    wanted = np.zeros((5, columns), bool)
    wanted[:, 12:15] = True
    np.testing.assert_array_equal(stuck_pixels(values), wanted)


def test_a_gap_beside_what_is_the_same_from_all_around_is_found():
    """Above a plate nothing changes beside the gap, which shows air where the plate is."""
    values = 0.01 * np.random.default_rng(4).standard_normal((VIEWS, 8, COLUMNS)).astype(np.float32)
    values[:, 5:] += 2.0
    values[:, :, 8:11] = 0.0
    wanted = np.zeros(values.shape[1:], bool)
    wanted[:, 8:11] = True
    np.testing.assert_array_equal(stuck_pixels(values), wanted)


def test_a_reconstruction_leaves_them_out_and_says_so(caplog):
    made = tps.simulate_scan("pins", 24, 40, geometry="fan")
    values = made.projections.copy()
    values[:, :, 14] = 0.9
    marked = np.ones(values.shape, bool)
    marked[:, :, 14] = False
    about = {"unit": made.unit, "spectrum": made.spectrum, "progress": False}
    about["settings"] = {"passes": 2, "views_per_step": 8}
    with caplog.at_level(logging.WARNING):
        found = tps.reconstruct(values, made.proj_geom, made.vol_geom, **about)
    assert "same value in every view are left out: 1" in caplog.text
    assert found.counts["rays_of_stuck_pixels"] == 40
    told = tps.reconstruct(values, made.proj_geom, made.vol_geom, valid=marked, **about)
    np.testing.assert_array_equal(found.volume, told.volume)
    assert told.counts["rays_of_stuck_pixels"] == 0
