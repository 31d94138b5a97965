"""What a scan cannot tell because a source passes there."""

import numpy as np
import pytest

from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.initial import initial_volume
from tomo_polysplat.start.source_planes import beyond_sources


def fan(radius, views=90, columns=121, tilt=0.0):
    """A full turn round the origin at this distance, with a detector as far behind it."""
    angle = 2 * np.pi * np.arange(views) / views
    out = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    u = 0.12 * np.stack([-np.sin(angle), np.cos(angle), 0 * angle], 1)
    v = 0.12 * (np.array([0.0, 0, 1]) + tilt * out)
    return Geometry("cone", radius * out, -radius * out - 0.5 * (columns - 1) * u, u, v, 1, columns)


def box(slices=1, half=1.0, size=21):
    high = half if slices > 1 else half / size
    return VolumeGrid((slices, size, size), [-half, -half, -high], [half, half, high])


def test_nothing_lies_beyond_far_sources_or_in_a_parallel_beam():
    assert beyond_sources(fan(1.5), box(), 0.0) is None
    far = fan(1.5)
    parallel = Geometry("parallel", far.origin, far.corner, far.u, far.v, far.rows, far.columns)
    assert beyond_sources(parallel, box(half=9.0), 1.0) is None


@pytest.mark.parametrize("slices", [1, 5])
@pytest.mark.parametrize("margin", [0.0, 0.2])
def test_sources_all_round_leave_a_circle(slices, margin):
    """The planes are its tangents, so that it is a polygon: of 90 sides, within 0.1 %."""
    grid = box(slices)
    x, y, _ = grid.axes()
    away = np.broadcast_to(np.hypot(x, y[:, None]), grid.shape)
    found = beyond_sources(fan(1.2), grid, margin)
    assert found.shape == grid.shape
    clear = np.abs(away - (1.2 - margin)) > 2e-3
    assert np.array_equal(found[clear], away[clear] > 1.2 - margin) and found.any() and not found.all()


def test_tilted_detectors_have_tilted_planes():
    """Seen from a source at x = 1.1, what is high is nearer to the plane when the detector leans."""
    geometry = fan(1.1, tilt=0.3).select([0])
    grid = box(5)
    found = beyond_sources(geometry, grid, 0.0)
    x, _, z = grid.axes()
    # The plane is spanned by u, along y, and v, along (0.3, 0, 1).
    expected = x - 0.3 * z[:, None] > 1.1
    assert found.any() and np.array_equal(found, np.broadcast_to(expected[:, None], grid.shape))


def test_the_start_is_empty_there_and_says_so(caplog):
    geometry, grid = fan(1.2), box()
    volume, info = initial_volume(np.ones(geometry.shape, np.float32), geometry, grid)
    near = beyond_sources(geometry, grid, 2 * 2 / 21)
    assert near.any() and not volume[near].any() and volume[~near].all()
    assert f"{near.sum()} voxels beyond the sources" in info["reason"] and "left empty" in caplog.text
