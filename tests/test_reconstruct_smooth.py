"""Objects with line integrals in closed form: smooth ones may not come out sharper than they are, and others may."""

import numpy as np
import pytest
from scipy import ndimage
from small_scans import fan, reconstruct

import tomo_polysplat as tps
from tomo_polysplat.scan.circular import parallel_geometry

COLUMNS, VIEWS = 49, 60
# What pixels and source did to it is asked in other files.
LIGHT = {"gains": False, "drift": False}
# x, y and deviation in pixels, attenuation in 1/pixel.
BLOBS = [(5.0, 3.0, 4.0, 0.05), (-8.0, -2.0, 3.0, 0.04), (1.0, -9.0, 5.0, 0.03)]

# The same of discs, with their radius.
DISCS = [(0.0, 0.0, 19.0, 0.04), (5.0, 3.0, 4.0, 0.05), (-8.0, -2.0, 5.0, -0.03), (1.0, -11.0, 3.0, 0.06)]


def smooth_scan(rows):
    """Projections (rows, views, columns) and true slices, ascending in z by a fifth."""
    theta = np.linspace(0, np.pi, VIEWS, endpoint=False)
    proj_geom, vol_geom = parallel_geometry(pixel=1.0, radians=theta, detector=(rows, COLUMNS))
    s, height = np.arange(COLUMNS) + 0.5 - COLUMNS / 2, 1 + 0.2 * np.arange(rows)
    y, x = np.meshgrid(s, s, indexing="ij")
    rays, slices = np.zeros((VIEWS, COLUMNS)), np.zeros((COLUMNS, COLUMNS))
    for x0, y0, width, value in BLOBS:
        across = s[None] - (x0 * np.cos(theta) + y0 * np.sin(theta))[:, None]
        rays += value * np.sqrt(2 * np.pi) * width * np.exp(-0.5 * (across / width) ** 2)
        slices += value * np.exp(-0.5 * ((x - x0) ** 2 + (y - y0) ** 2) / width**2)
    stack = (height[:, None, None] * rays).astype(np.float32)
    return stack, proj_geom, vol_geom, height[:, None, None] * slices


@pytest.mark.parametrize("rows", [1, 3])
def test_values_of_a_smooth_object_are_true(rows):
    projections, proj_geom, vol_geom, truth = smooth_scan(rows)
    options = {"unit": "pixel", "quality": "fast", "settings": {"views_per_step": 4}}
    result = tps.reconstruct(projections, proj_geom, vol_geom, progress=False, **options)
    inside = truth > 0.2 * truth.max()
    slope = np.polyfit(truth[inside], result.volume[inside], 1)[0]
    assert slope == pytest.approx(1, abs=0.02)
    assert np.sqrt(np.mean((result.volume - truth) ** 2)) < 0.005 * truth.max()
    assert "without metal" in result.plan["detector_blur"].why


def disc_scan(blur):
    """Projections (rows, views, columns) and true slices of discs before a detector that spreads light (pixels)."""
    theta = np.linspace(0, np.pi, VIEWS, endpoint=False)
    proj_geom, vol_geom = parallel_geometry(pixel=1.0, radians=theta, detector=(5, COLUMNS))
    finer = 8
    s = (np.arange(finer * COLUMNS) + 0.5) / finer - COLUMNS / 2
    y, x = np.meshgrid(s, s, indexing="ij")
    rays, slices = np.zeros((VIEWS, finer * COLUMNS)), np.zeros((finer * COLUMNS,) * 2)
    for x0, y0, radius, value in DISCS:
        across = s[None] - (x0 * np.cos(theta) + y0 * np.sin(theta))[:, None]
        rays += 2 * value * np.sqrt(np.maximum(radius**2 - across**2, 0))
        slices += value * ((x - x0) ** 2 + (y - y0) ** 2 < radius**2)
    light = np.exp(-rays)
    if blur:
        light = ndimage.gaussian_filter1d(light, finer * blur, axis=1, mode="nearest")
    seen = -np.log(light.reshape(VIEWS, COLUMNS, finer).mean(axis=2))
    truth = slices.reshape(COLUMNS, finer, COLUMNS, finer).mean(axis=(1, 3))
    return np.repeat(seen[None].astype(np.float32), 5, axis=0), proj_geom, vol_geom, truth


def test_sharp_edges_without_metal_show_the_detector_blur():
    *scan, truth = disc_scan(0.6)
    # Where the scanner stood is asked in other files.
    options, settings = {"unit": "pixel", "progress": False, "align": False}, {"views_per_step": 8} | LIGHT
    fitted = tps.reconstruct(*scan, settings=settings, **options)
    held = tps.reconstruct(*scan, settings=settings | {"blur": 0.0, "learning_rate_blur": 0.0}, **options)
    # A pixel's own area is a blur of a twelfth.
    assert fitted.plan["fitted_blur"].value == pytest.approx(0.6**2 + 1 / 12, abs=0.15)
    error, without = (np.sqrt(np.mean((r.volume[2] - truth) ** 2)) for r in (fitted, held))
    assert error < 0.8 * without


def test_blur_is_fitted_where_there_is_metal_and_held_where_asked():
    assert "fitted" in reconstruct(fan()).plan["detector_blur"].why
    assert "in so few passes" in reconstruct(fan(metal=False)).plan["detector_blur"].why
    held = reconstruct(fan(metal=False), settings={"passes": 1, "blur": 0.3, "learning_rate_blur": 0})
    assert "0.300" in held.plan["detector_blur"].why
