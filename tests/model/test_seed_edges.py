"""Seeds at a plane whose direction is known."""

import math

import numpy as np
import pytest
import torch

from tomo_polysplat.model.seed_edges import edge_shapes
from tomo_polysplat.scan.geometry import VolumeGrid
from tomo_polysplat.settings import Settings

HALF, FINEST = 0.2, 0.13


def plane(shape, voxel, normal, scale=1.0):
    """A grid, its voxels' centres (nz, ny, nx, 3), and a volume that rises from 0 to 1 across a plane."""
    half = 0.5 * np.array(shape[::-1]) * np.array(voxel)
    grid = VolumeGrid(shape, -half * scale, half * scale)
    z, y, x = np.meshgrid(*grid.axes()[::-1], indexing="ij")
    points = np.stack([x, y, z], -1)
    height = 1 / (1 + np.exp(-(points @ normal) / (0.05 * scale)))
    return grid, torch.from_numpy(points.reshape(-1, 3)), torch.from_numpy(height)


def first_axis(rotation):
    """Where quaternions (w, x, y, z) turn the x axis to: the first column of the rotation matrix."""
    w, x, y, z = rotation.unbind(1)
    return torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1)


def shapes(case, size, finest=FINEST, half=HALF):
    grid, points, height = case
    dims = 2 if grid.planar else 3
    sizes = torch.full((len(points),), size).double()
    return edge_shapes(height, points, sizes, grid, Settings(seed_edge=half), finest, dims)


@pytest.mark.parametrize(
    "shape, voxel, normal",
    [
        ((25, 23, 27), (0.1, 0.1, 0.1), (0.6, -0.64, 0.48)),
        ((25, 23, 27), (0.1, 0.1, 0.1), (-1.0, 0.0, 0.0)),
        ((7, 41, 37), (0.05, 0.06, 0.3), (0.0, 0.6, 0.8)),
        ((1, 33, 35), (0.1, 0.1, 0.1), (-0.8, 0.6, 0.0)),
    ],
)
def test_seeds_at_an_edge_are_thin_across_it_and_keep_their_mass(shape, voxel, normal):
    normal = np.array(normal)
    case = plane(shape, voxel, normal)
    grid, points, _ = case
    rotation, change = shapes(case, 0.3)
    assert torch.allclose(change.sum(dim=1), torch.zeros(len(points), dtype=change.dtype), atol=1e-12)
    assert torch.allclose(rotation.norm(dim=1), torch.ones(len(points), dtype=rotation.dtype))
    distance = (points @ torch.from_numpy(normal)).abs()
    inside = (points.abs() < torch.from_numpy(0.5 * grid.extent - 2.5 * np.array(voxel))).numpy()
    inside = torch.from_numpy(inside[:, :2].all(axis=1) if grid.planar else inside.all(axis=1))
    at, far = inside & (distance < 0.03), distance > 1.0
    assert int(at.sum()) > 3 and float(change[at, 0].max()) < math.log(0.6)
    assert float(((first_axis(rotation[at]) @ torch.from_numpy(normal)).abs()).min()) > 0.98
    assert not bool(far.any()) or float(change[far].abs().max()) < 0.01


def test_none_is_thinner_than_the_detector_could_tell_apart():
    case = plane((15, 17, 19), (0.1, 0.1, 0.1), np.array([1.0, 0.0, 0.0]))
    for size, finest in ((0.3, 0.21), (0.17, 0.13), (0.5, 0.4)):
        thinnest = float(shapes(case, size, finest, half=1e-6)[1].min())
        assert thinnest == pytest.approx(math.log(finest / size))
    for round_ones in (
        shapes(case, 0.13),
        shapes(case, 0.0),
        shapes(case, 0.3, half=0.0),
        shapes(case, 0.3, math.inf),
    ):
        rotation, change = round_ones
        assert not change.any() and bool((rotation[:, 0] == 1).all()) and not rotation[:, 1:].any()


def test_the_unit_of_length_does_not_matter():
    normal = np.array([0.48, 0.6, -0.64])
    small = shapes(plane((13, 15, 17), (0.1, 0.1, 0.1), normal), 0.3)
    large = shapes(plane((13, 15, 17), (0.1, 0.1, 0.1), normal, 1e3), 300.0, 1e3 * FINEST)
    steep = small[1][:, 0] < math.log(0.95)
    torch.testing.assert_close(small[1], large[1])
    torch.testing.assert_close(small[0][steep], large[0][steep])


def test_where_edges_are_sharp_seeds_are_thin_however_close_but_not_at_metal():
    grid, points, height = plane((13, 11, 15), (0.1, 0.1, 0.1), np.array([1.0, 0.0, 0.0]))
    _, change = shapes((grid, points, height), 0.05, finest=0.0)
    assert (
        float(change[:, 0].min()) < -0.2 and float(shapes((grid, points, height), 0.05)[1].abs().max()) == 0
    )
    _, change = shapes((grid, points, height * 40), 0.05, finest=0.0)
    metal = height.reshape(-1) * 40 > Settings().metal_level
    assert bool(change.isfinite().all()) and float(change[metal].abs().max()) == 0
