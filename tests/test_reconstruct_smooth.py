"""A smooth object with line integrals in closed form: nothing in it may come out sharper than it is."""

import numpy as np
import pytest
from small_scans import fan, reconstruct

import tomo_polysplat as tps
from tomo_polysplat.scan.circular import parallel_geometry

COLUMNS, VIEWS = 49, 60
# x, y and deviation in pixels, attenuation in 1/pixel.
BLOBS = [(5.0, 3.0, 4.0, 0.05), (-8.0, -2.0, 3.0, 0.04), (1.0, -9.0, 5.0, 0.03)]


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


def test_blur_is_fitted_where_there_is_metal_and_held_where_asked():
    assert "fitted" in reconstruct(fan()).plan["detector_blur"].why
    assert "without metal" in reconstruct(fan(metal=False)).plan["detector_blur"].why
    held = reconstruct(fan(metal=False), settings={"passes": 1, "blur": 0.3, "learning_rate_blur": 0})
    assert "0.300" in held.plan["detector_blur"].why
