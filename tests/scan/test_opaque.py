"""Rays without light: opaque behind dense matter, nothing known of them elsewhere."""

import numpy as np
import pytest
from scipy import ndimage

import tomo_polysplat as tps
from tomo_polysplat.scan.check import check_scan
from tomo_polysplat.scan.opaque import _surrounded, fill_opaque
from tomo_polysplat.scan.usable import usable_rays

PHOTONS = 1e4
# What pixels and source did to the light is asked in other files.
SETTINGS = {"passes": 10, "views_per_step": 10, "tv_factor": 1.0, "gains": False, "drift": False}


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


def test_one_wrong_pixel_changes_nothing_elsewhere():
    values, plain = views(), views()
    values[:, 0, 2] = 700.0
    assert fill_opaque(values, PHOTONS) == fill_opaque(plain, PHOTONS)
    np.testing.assert_array_equal(values[:, 1:], plain[:, 1:])


def test_pieces_are_judged_as_one_by_one():
    """Against a loop over the pieces, on scattered ones that touch, lie at corners, and hold NaN."""
    random = np.random.default_rng(3)
    view = random.uniform(0, 9, (31, 43)).astype(np.float32)
    view[random.random(view.shape) < 0.25], view[random.random(view.shape) < 0.02] = np.inf, np.nan
    lightless, wanted = np.isposinf(view), np.zeros(view.shape, bool)
    labels, number = ndimage.label(lightless, np.ones((3, 3)))
    for label in range(1, number + 1):
        around = view[ndimage.binary_dilation(labels == label, np.ones((3, 3))) & np.isfinite(view)]
        if len(around) and np.quantile(around, 0.75, method="higher") >= 5:
            wanted |= labels == label
    np.testing.assert_array_equal(lightless & _surrounded(view, lightless, 5.0), wanted)
    assert 0 < wanted.sum() < lightless.sum()


@pytest.mark.parametrize("photons", [np.inf, 1.0])
def test_without_known_noise_nothing_is_known_of_them(photons):
    values = views()
    assert fill_opaque(values, photons) == 0
    assert np.isnan(values[:3, :, 10:15]).all()
    alone = np.full((2, 3, 4), np.inf, np.float32)
    assert fill_opaque(alone, PHOTONS) == 0 and np.isnan(alone).all(), "no ray with light in view"


def rod(beside, photons=2e3):
    """A slice of a rod of lead in water, through whose middle no light passes, and its truth at one energy."""
    n, views, cell = 32, 120, 0.125
    place = (np.arange(n) - 0.5 * (n - 1)) * cell
    x, y = np.meshgrid(place, place)
    truth = np.where(np.hypot(x, y) < 1.6, 0.2, 0.0) + np.where(np.hypot(x - beside, y) < 0.55, 12.0, 0.0)
    angles = np.pi * np.arange(views) / views
    offset = (np.arange(48) - 23.5) * 0.1
    chord = lambda s, r: 2 * np.sqrt(np.maximum(r**2 - s**2, 0))  # noqa: E731
    centre = beside * np.cos(angles)[:, None]
    value = 0.2 * chord(offset[None], 1.6) + 12.0 * chord(offset[None] - centre, 0.55)
    counts = np.random.default_rng(0).poisson(photons * np.exp(-value))
    with np.errstate(divide="ignore"):
        projections = -np.log(counts / photons).astype(np.float32)
    geometry = {"type": "parallel", "DetectorWidth": 0.1, "DetectorCount": 48, "ProjectionAngles": angles}
    half = n * cell / 2
    window = {"WindowMinX": -half, "WindowMaxX": half, "WindowMinY": -half, "WindowMaxY": half}
    return projections, geometry, {"GridRowCount": n, "GridColCount": n, "option": window}, truth


@pytest.mark.parametrize("beside", [0.0, 0.5])
def test_opaque_metal_keeps_more_of_its_mass(beside):
    """On the axis some pixels see it in every view, as they would if they were dead."""
    projections, geometry, volume, truth = rod(beside)
    lightless = np.isinf(projections)
    assert lightless.mean() > 0.05
    about = {"progress": False, "align": False, "settings": SETTINGS}
    told = tps.reconstruct(projections, geometry, volume, **about)
    left = tps.reconstruct(projections, geometry, volume, valid=~lightless, **about)
    # Beside a sharp rim the next ray may be bright.
    assert 0.6 * lightless.sum() < told.counts["rays_opaque"] <= lightless.sum()
    assert told.counts["rays_opaque"] + told.counts["rays_not_finite"] == lightless.sum()
    assert left.counts["rays_opaque"] == 0 and left.counts["rays_marked_invalid"] == lightless.sum()
    mass = [
        abs(float(result.volume[truth > 5].sum() / truth[truth > 5].sum()) - 1) for result in (told, left)
    ]
    assert mass[0] < 0.8 * mass[1]
    # Dead pixels count nothing either, and must not make matter of air.
    dead = projections.copy()
    dead[:, 2] = np.inf
    # Counted before the first step.
    hasty = about | {"settings": SETTINGS | {"passes": 1, "views_per_step": 120}}
    counts = tps.reconstruct(dead, geometry, volume, **hasty).counts
    assert counts["rays_opaque"] == told.counts["rays_opaque"]


def test_a_shadow_that_moves_is_opaque_however_bright_it_is_beside_it():
    """A pin of gold in air; pixels that are dead, fail for a time, or fail at random are none."""
    random, views, columns = np.random.default_rng(1), 60, 64
    values = np.full((views, 5, columns), 0.5, np.float32)
    middle = 32 + 20 * np.sin(np.linspace(0, np.pi, views))
    pin = np.abs(np.arange(columns) - middle[:, None]) < 2.5
    values[np.broadcast_to(pin[:, None], values.shape)] = np.inf
    failing = np.zeros(values.shape, bool)
    failing[:, :, 3:6] = True
    failing[20:40, 1:4, 9:12] = True
    failing[:, 2, 15:20] = random.random((views, 5)) < 0.7
    failing[random.random(values.shape) < 0.05] = True
    failing &= ndimage.distance_transform_cdt(~np.broadcast_to(pin[:, None], values.shape)) > 3
    values[failing] = np.inf
    # The shadow's rim is left out in the first and the last view.
    assert fill_opaque(values, PHOTONS) >= 0.98 * 5 * pin.sum()
    assert np.isnan(values[failing]).all()


def test_a_shadow_is_followed_as_by_a_label_of_all_views():
    from tomo_polysplat.scan.shadows import moving_shadows

    values = np.where(np.random.default_rng(4).random((12, 9, 11)) < 0.3, np.inf, 1.0)
    found = np.stack([np.zeros((9, 11), bool) if one is None else one for one in moving_shadows(values)])
    near = np.zeros((3, 3, 3))
    near[1], near[:, 1, 1] = 1, 1
    dark = np.isinf(values)
    beside = np.pad(dark, ((1, 1), (0, 0), (0, 0)))
    labels, number = ndimage.label(dark & (beside[:-2] | beside[2:]), near)
    wanted = np.zeros(values.shape, bool)
    for label in range(1, number + 1):
        one = labels == label
        if one.any(axis=(1, 2)).sum() >= 5:
            wanted |= one & (one.any(axis=0).sum() >= 1.5 * one.sum(axis=(1, 2)).max())
    np.testing.assert_array_equal(found, wanted)
    assert 0 < found.sum() < (labels > 0).sum()


@pytest.mark.parametrize("limit", [1e-2, 2e-3, 1e-9], ids=str)
def test_rays_clipped_to_one_value_are_opaque(limit):
    """Programs clip counts before the logarithm; the value of such rays is a bound, however far down it lies."""
    projections, geometry, _, _ = rod(0.5)
    darker = (projections >= -np.log(limit))[:, None]
    told, counts, _ = usable_rays(np.minimum(projections, np.float32(-np.log(limit))), geometry, None)
    clear, _, _ = usable_rays(np.where(darker[:, 0], np.inf, projections), geometry, None)
    np.testing.assert_array_equal(told[~darker], clear[~darker])
    # Single dark rays beside a bright one are left as they are.
    same = told[darker] == clear[darker]
    assert same.mean() > 0.9 and counts["rays_opaque"] == same.sum() and counts["rays_not_finite"] == 0
    assert (told[darker][~same] == np.float32(-np.log(limit))).all()


def test_rays_clipped_to_less_than_a_photon_keep_their_value():
    projections, geometry, _, _ = rod(0.5)
    value = np.float32(np.log(2.5 * 2e3))
    told, counts, _ = usable_rays(np.minimum(projections, value), geometry, None)
    assert told.max() == value and 0.9 < counts["rays_opaque"] / np.isinf(projections).sum() <= 1


def test_what_is_not_at_the_end_of_the_scale_stays_as_it_is():
    """Noise, plain values, few counts, detail that is bright, and data without noise."""
    projections, geometry, _, _ = rod(0.5)
    finite = np.where(
        np.isfinite(projections), projections, 7.0 + np.random.default_rng(0).random(projections.shape)
    )
    random = np.random.default_rng(1)
    few = -np.log(np.maximum(random.poisson(30 * np.exp(-np.minimum(finite, 2.5))), 1) / 30)
    smooth = np.minimum(np.linspace(0, 4, finite.size), 3.0).reshape(finite.shape)
    bright = np.minimum(finite, 0.3)
    for values in (finite, few, smooth, bright):
        told, counts, _ = usable_rays(values.astype(np.float32), geometry, None)
        np.testing.assert_array_equal(told[:, 0], values.astype(np.float32))
        assert counts["rays_opaque"] == 0


def test_check_has_nothing_to_mend_in_clipped_rays():
    """To leave them out costs the metal more than half of what it keeps."""
    projections, geometry, volume, _ = rod(0.5)
    clipped = np.minimum(projections, np.float32(-np.log(2e-3)))[None]
    half = 2.0
    geometry = geometry | {"type": "parallel3d", "DetectorSpacingX": 0.1, "DetectorSpacingY": 0.1}
    geometry |= {"DetectorRowCount": 1, "DetectorColCount": geometry["DetectorCount"]}
    volume = {"GridRowCount": 32, "GridColCount": 32, "GridSliceCount": 1, "option": volume["option"]}
    volume["option"] = volume["option"] | {"WindowMinZ": -half / 32, "WindowMaxZ": half / 32}
    found = check_scan(tps.Scan(clipped, geometry, volume))[0]
    assert found.probe == "bad rays" and found.verdict == "ok" and "without light" in found.text
