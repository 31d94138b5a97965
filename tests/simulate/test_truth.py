"""The voxelised truth."""

import numpy as np
import pytest

from tomo_polysplat.simulate.phantom import Part, Phantom
from tomo_polysplat.simulate.shapes import box, cylinder, ellipsoid, rotation
from tomo_polysplat.simulate.truth import voxelise_truth

LOWER, UPPER = np.array([-1.0, -1.2, -0.8]), np.array([1.0, 1.2, 0.8])


def test_truth_is_the_mean_over_sample_points():
    parts = [
        Part(ellipsoid((0.1, 0.2, 0.0), (0.7, 0.5, 0.6), rotation((1, 2, 3), 40)), "water", 1.0),
        Part(box((0, 0, 0.1), (0.2, 0.5, 0.3), rotation((0, 1, 0), 25)), "bone", 1.8),
        Part(cylinder((-0.1, 0.2, 0), 0.12, 0.5, (1, 1, 0.2)), "iron", 7.8, metal=True),
        Part(ellipsoid((-0.1, 0.2, 0), 0.09), "water", 0.0),
    ]
    values = np.array([0.2, 0.6, 3.1])
    shape = (5, 9, 7)
    mu, metal = voxelise_truth(Phantom(parts), values, shape, LOWER, UPPER, samples=2)
    step = (UPPER - LOWER) / (2 * np.array(shape[::-1]))
    axes = [LOWER[k] + (np.arange(2 * shape[2 - k]) + 0.5) * step[k] for k in range(3)]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    points = np.stack([x, y, z], axis=-1)
    fine, fine_metal = np.zeros(x.shape), np.zeros(x.shape, bool)
    for part, value in zip(parts, (0.2, 0.6, 3.1, 0.2)):
        inside = part.shape.contains(points)
        fine[inside], fine_metal[inside] = part.density * value, part.metal
    blocks = (5, 2, 9, 2, 7, 2)
    assert 0 < metal.sum() < metal.size
    np.testing.assert_allclose(mu, fine.reshape(blocks).mean(axis=(1, 3, 5)), atol=1e-6)
    np.testing.assert_array_equal(metal, fine_metal.reshape(blocks).any(axis=(1, 3, 5)))


@pytest.mark.parametrize("shape", [(12, 12, 12), (11, 17, 13)])
def test_mass_is_kept_and_sits_in_the_right_place(shape):
    ball = ellipsoid((0.3, -0.4, 0.2), 0.5)
    mu, _ = voxelise_truth(Phantom([Part(ball, "water", 1.0)]), np.array([1.0]), shape, LOWER, UPPER)
    voxel = (UPPER - LOWER) / np.array(shape[::-1])
    assert mu.sum() * voxel.prod() == pytest.approx(ball.volume, rel=0.02)
    centres = [LOWER[k] + (np.arange(shape[2 - k]) + 0.5) * voxel[k] for k in range(3)]
    weighted = [
        (mu.sum(axis=tuple(a for a in range(3) if a != 2 - k)) * centres[k]).sum() / mu.sum()
        for k in range(3)
    ]
    np.testing.assert_allclose(weighted, ball.centre, atol=0.02)


def test_planar_truth_is_the_section_at_the_middle():
    cone_like = Phantom([Part(ellipsoid((0, 0, 0), (0.8, 0.8, 0.05)), "water", 1.0)])
    window = np.array([-1.0, -1.0, -0.2]), np.array([1.0, 1.0, 0.2])
    section, _ = voxelise_truth(cone_like, np.array([1.0]), (1, 21, 21), *window, planar=True)
    slab, _ = voxelise_truth(cone_like, np.array([1.0]), (1, 21, 21), *window)
    assert section[0, 10, 10] == 1.0
    assert slab[0, 10, 10] < 0.5
