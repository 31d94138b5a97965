"""The axis of rotation from opposite rays: found to hundredths of a pixel, with an error that can be believed."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import shift

import tomo_polysplat as tps
from tomo_polysplat.scan.axis_offset import axis_offset
from tomo_polysplat.scan.geometry import from_astra, projections_from_astra
from tomo_polysplat.scan.view_geometry import Geometry

# Beam, degrees, views: with opposite views, between views, at a seam alone, and past it.
KINDS = [
    ("parallel", 360.0, 40),
    ("parallel", 360.0, 41),
    ("parallel", 180.0, 48),
    ("parallel", 200.0, 50),
    ("fan", 360.0, 60),
    ("fan", 230.0, 60),
    ("cone", 360.0, 45),
]


@cache
def measured(beam, arc, views, scene="teeth", photons=1e5):
    scan = tps.simulate_scan(scene, 28, views, geometry=beam, arc_degrees=arc, photons=photons)
    return projections_from_astra(scan.projections, scan.proj_geom), from_astra(
        scan.proj_geom, scan.vol_geom
    )[0]


def beside(geometry, columns):
    """The told geometry of a detector that stood so many columns above it."""
    return replace(geometry, corner=geometry.corner - columns * geometry.u)


@pytest.mark.parametrize("beam, arc, views", KINDS)
def test_an_axis_is_found_wherever_it_is(beam, arc, views):
    values, geometry = measured(beam, arc, views)
    for columns in (0.0, 0.37, -2.0, 3.6):
        found = axis_offset(values, beside(geometry, columns))
        assert not found.doubt and found.error < 0.04
        assert abs(found.columns - columns) < min(4 * found.error, 0.05)


@pytest.mark.parametrize("end", [180.0, 179.9998, 180.0002])
def test_a_half_turn_to_its_end_but_for_what_motors_miss(end):
    """49 views, of which the last sees what the first did from behind, a little too early or too late."""
    values, geometry = measured("parallel", end * 49 / 48, 49)
    for columns in (0.0, -2.4):
        found = axis_offset(values, beside(geometry, columns))
        assert not found.doubt and abs(found.columns - columns) < 0.05
    # A view that lacks a tenth of a step is none.
    values, geometry = measured("parallel", (180 - 0.375) * 49 / 48, 49)
    assert axis_offset(values, geometry).doubt == "no ray was measured from both ends"


def test_nothing_depends_on_how_views_and_columns_are_counted():
    values, geometry = measured("fan", 360.0, 60)
    told = beside(geometry, 0.8)
    found = axis_offset(values, told)
    order = np.random.default_rng(0).permutation(60)
    mixed = axis_offset(values[order], told.select(order))
    assert mixed.columns == pytest.approx(found.columns, abs=1e-6)
    # The other way along the columns the detector stood the other way.
    last = replace(told, corner=told.corner + (told.columns - 1) * told.u, u=-told.u)
    assert axis_offset(values[..., ::-1], last).columns == pytest.approx(-found.columns, abs=1e-6)


def test_an_axis_of_a_parallel_beam_need_not_run_through_the_origin():
    values, geometry = measured("parallel", 180.0, 48)
    told, there = beside(geometry, 0.5), np.array([0.3, -0.2, 0.1])
    found, moved = axis_offset(values, told), axis_offset(values, told.shifted(there))
    assert moved.columns == pytest.approx(found.columns, abs=1e-6)


def test_gains_of_pixels_dead_rays_and_a_gap_are_no_shift():
    values, geometry = measured("fan", 360.0, 60)
    rng = np.random.default_rng(3)
    gained = (
        values + rng.normal(0, 0.03, (1, *values.shape[1:])) + 0.05 * np.linspace(-1, 1, geometry.columns)
    )
    holes = np.where(rng.random(values.shape) < 0.01, np.nan, values)
    holes[..., 13:15] = np.nan
    for spoilt in (gained, holes):
        found = axis_offset(spoilt, geometry)
        assert abs(found.columns) < 4 * found.error + 0.01 and found.error < 0.1


def disc(angles, columns, radius, place):
    """Parallel projections (views, 1, columns) of a disc of density 0.1, and their geometry; lengths in pixels."""
    across = np.stack([-np.sin(angles), np.cos(angles), 0 * angles], 1)
    beam = np.stack([-np.cos(angles), -np.sin(angles), 0 * angles], 1)
    up = np.tile([0.0, 0.0, 1.0], (len(angles), 1))
    fine = (np.arange(4 * columns) + 0.5) / 4 - 0.5 * columns
    away = fine - (across[:, :2] @ np.asarray(place))[:, None]
    chords = 0.2 * np.sqrt(np.maximum(radius**2 - away**2, 0))
    values = -np.log(np.exp(-chords).reshape(len(angles), 1, columns, 4).mean(axis=-1))
    return values, Geometry("parallel", beam, -0.5 * (columns - 1) * across, across, up, 1, columns)


@pytest.mark.parametrize("place", [(4.0, 2.0), (0.0, 0.0)])
def test_a_flat_field_that_slopes_is_no_shift_of_half_a_turn(place):
    values, geometry = disc(np.deg2rad(np.arange(60) * 3.0), 64, 20.0, place)
    sloped = values - np.log(1 + 0.05 * np.linspace(-1, 1, 64))
    for columns in (0.0, 0.6):
        found = axis_offset(sloped, beside(geometry, columns))
        assert not found.doubt and found.error < 0.05
        assert abs(found.columns - columns) < 3 * found.error + 0.01


@pytest.mark.parametrize("density", [0.0, 0.02, 1.0])
def test_what_stands_still_in_all_views_is_no_axis(density):
    values, geometry = disc(np.deg2rad(np.arange(60) * 6.0), 64, 9.0, (11.0, 0.0))
    hair = 0.3 * np.exp(-0.5 * ((np.arange(64) - 25) / 1.5) ** 2)
    noise = np.random.default_rng(0).normal(0, 1e-3, values.shape)
    found = axis_offset(density * values + hair + noise, geometry)
    assert found.doubt or abs(found.columns) < 4 * found.error + 0.03
    # A body of revolution about the axis may as well be a defect of pixels.
    centred = disc(np.deg2rad(np.arange(60) * 6.0), 64, 9.0, (0.0, 0.0))[0]
    assert axis_offset(centred + noise, geometry).doubt


@pytest.mark.parametrize("many", [60, 61])
def test_views_that_wobble_make_the_error_of_a_seam_as_large_as_that(many):
    """Of 61 views the last is the first from behind, and all that there is."""
    values, geometry = disc(np.deg2rad(np.arange(many) * 3.0), 64, 12.0, (9.0, 5.0))
    surely = axis_offset(values, geometry).error
    for seed in range(3):
        wobble = np.random.default_rng(seed).normal(0, 0.3, many)
        moved = np.stack([shift(view, (0, by), order=3) for view, by in zip(values, wobble)])
        found = axis_offset(moved, geometry)
        assert abs(found.columns) < 3 * found.error and 0.1 < found.error < 0.6 and surely < 0.03


@pytest.mark.parametrize("arc", [180.0, 200.0])
def test_few_views_of_what_is_thin_and_fast_make_the_error_larger(arc):
    for views in (16, 24, 40):
        values, geometry = disc(np.deg2rad(np.arange(views) * arc / views), 64, 2.0, (20.0, 0.0))
        found = axis_offset(values, geometry)
        assert found.doubt or abs(found.columns) < 4 * found.error + 0.03


def test_noise_makes_the_error_larger_and_no_shift():
    for photons, seed in ((1e3, 0), (30.0, 1)):
        values, geometry = measured("cone", 360.0, 45)
        counts = np.random.default_rng(seed).poisson(photons * np.exp(-values.astype(float)))
        found = axis_offset(-np.log(np.maximum(counts, 0.5) / photons), geometry)
        assert found.doubt or abs(found.columns) < 4 * found.error
    assert found.error > 0.01


@pytest.mark.parametrize(
    "change, why",
    [
        (lambda p, g: (p[:12], g.select(slice(12))), "both ends"),
        (lambda p, g: (np.full_like(p, np.nan), g), "both ends"),
        (lambda p, g: (np.zeros_like(p), g), "do not"),
        (lambda p, g: (np.random.default_rng(0).normal(size=p.shape), g), "do not"),
        (lambda p, g: (p[:8], g.select(slice(8))), "fewer than"),
        (
            lambda p, g: (p, replace(g, origin=g.origin + np.linspace(0, 1, 60)[:, None] * [0, 0, 9])),
            "circle",
        ),
    ],
)
def test_what_rays_do_not_tell_is_said(change, why):
    values, geometry = measured("fan", 360.0, 60)
    found = axis_offset(*change(values, geometry))
    assert why in found.doubt and found.columns == 0.0 and found.error == np.inf
