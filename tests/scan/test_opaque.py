"""Rays without light: opaque behind dense matter, nothing known of them elsewhere."""

import numpy as np
import pytest

import tomo_polysplat as tps
from tomo_polysplat.scan.opaque import fill_opaque

PHOTONS = 1e4


def views():
    """(views, rows, columns) of soft matter; in three of five views dense matter, opaque at columns 10 to 14."""
    line = np.full(23, 1.5, np.float32)
    line[[8, 16]], line[[9, 15]] = 5.0, 8.0
    line[10:15] = np.inf
    without = np.full(23, 1.5, np.float32)
    return np.concatenate([np.tile(line, (3, 5, 1)), np.tile(without, (2, 5, 1))])


def test_what_dark_rays_surround_gets_a_value_and_the_rest_is_left_out():
    """A dead column is not, whatever there is beside it; nor single rays that are missing."""
    values = views()
    values[0, 2, 4] = values[1, :, 20] = np.inf
    values[2, 1, 2] = np.nan
    values[:, :, 18] = np.inf
    assert fill_opaque(values, PHOTONS) == 3 * 5 * 5
    assert (values[:3, :, 10:15] == np.float32(np.log(10 * PHOTONS))).all()
    assert np.isnan(values[0, 2, 4]) and np.isnan(values[1, :, 20]).all() and np.isnan(values[2, 1, 2])
    np.testing.assert_array_equal(
        values[2, :, :10], np.where(np.isnan(values[2, :, :10]), np.nan, views()[2, :, :10])
    )


def test_no_ray_is_less_opaque_than_one_that_was_measured():
    values = views()
    values[:, 0, 9] = 13.0
    fill_opaque(values, PHOTONS)
    assert (values[:3, :, 12] == 13.0).all()


@pytest.mark.parametrize("photons", [np.inf, 1.0])
def test_without_known_noise_nothing_is_known_of_them(photons):
    values = views()
    assert fill_opaque(values, photons) == 0
    assert np.isnan(values[:3, :, 10:15]).all()
    alone = np.full((2, 3, 4), np.inf, np.float32)
    assert fill_opaque(alone, PHOTONS) == 0 and np.isnan(alone).all(), "no ray with light in view"


def rod(photons=2e3):
    """A slice of a rod of lead in water, through whose middle no light passes, and its truth at one energy."""
    n, views, cell = 32, 120, 0.125
    place = (np.arange(n) - 0.5 * (n - 1)) * cell
    x, y = np.meshgrid(place, place)
    truth = np.where(np.hypot(x, y) < 1.6, 0.2, 0.0) + np.where(np.hypot(x - 0.5, y) < 0.55, 12.0, 0.0)
    angles = np.pi * np.arange(views) / views
    offset = (np.arange(48) - 23.5) * 0.1
    chord = lambda s, r: 2 * np.sqrt(np.maximum(r**2 - s**2, 0))  # noqa: E731
    centre = 0.5 * np.cos(angles)[:, None]
    value = 0.2 * chord(offset[None], 1.6) + 12.0 * chord(offset[None] - centre, 0.55)
    counts = np.random.default_rng(0).poisson(photons * np.exp(-value))
    with np.errstate(divide="ignore"):
        projections = -np.log(counts / photons).astype(np.float32)
    geometry = {"type": "parallel", "DetectorWidth": 0.1, "DetectorCount": 48, "ProjectionAngles": angles}
    half = n * cell / 2
    window = {"WindowMinX": -half, "WindowMaxX": half, "WindowMinY": -half, "WindowMaxY": half}
    return projections, geometry, {"GridRowCount": n, "GridColCount": n, "option": window}, truth


def test_opaque_metal_keeps_more_of_its_mass():
    projections, geometry, volume, truth = rod()
    lightless = np.isinf(projections)
    assert lightless.mean() > 0.05
    about = {"progress": False, "settings": {"passes": 10}}
    told = tps.reconstruct(projections, geometry, volume, **about)
    left = tps.reconstruct(projections, geometry, volume, valid=~lightless, **about)
    assert (
        0.85 * lightless.sum()
        < told.counts["rays_opaque"]
        <= lightless.sum()
        == told.counts["rays_not_finite"]
    )
    assert left.counts["rays_opaque"] == 0 and left.counts["rays_marked_invalid"] == lightless.sum()
    mass = [
        abs(float(result.volume[truth > 5].sum() / truth[truth > 5].sum()) - 1) for result in (told, left)
    ]
    assert mass[0] < 0.8 * mass[1]
    # Dead pixels count nothing either, and must not make matter of air.
    dead = projections.copy()
    dead[:, 2] = np.inf
    assert (
        tps.reconstruct(dead, geometry, volume, **about).counts["rays_opaque"] == told.counts["rays_opaque"]
    )
