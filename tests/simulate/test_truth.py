"""The voxelised truth."""

import numpy as np
import pytest

from tomo_polysplat.simulate.phantom import Part, Phantom
from tomo_polysplat.simulate.shapes import box, cylinder, ellipsoid, rotation
from tomo_polysplat.simulate.truth import voxelise_truth

LOWER, UPPER = np.array([-1.0, -1.2, -0.8]), np.array([1.0, 1.2, 0.8])


def nested():
    """Parts that cover each other, and a bubble in the metal."""
    return [
        Part(ellipsoid((0.1, 0.2, 0.0), (0.7, 0.5, 0.6), rotation((1, 2, 3), 40)), "water", 1.0),
        Part(box((0, 0, 0.1), (0.2, 0.5, 0.3), rotation((0, 1, 0), 25)), "bone", 1.8),
        Part(cylinder((-0.1, 0.2, 0), 0.12, 0.5, (1, 1, 0.2)), "iron", 7.8, metal=True),
        Part(ellipsoid((-0.1, 0.2, 0), 0.09), "water", 0.0),
    ]


def sampled(parts, densities, shape, samples, lower, upper):
    """Mean and mask of every voxel from ``samples`` points along each of its edges, all of them asked for."""
    step = (upper - lower) / (samples * np.array(shape[::-1]))
    axes = [lower[k] + (np.arange(samples * shape[2 - k]) + 0.5) * step[k] for k in range(3)]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    points = np.stack([x, y, z], axis=-1)
    fine, metal = np.zeros(x.shape), np.zeros(x.shape, bool)
    for part, value in zip(parts, densities):
        inside = part.shape.contains(points)
        fine[inside], metal[inside] = part.density * value, part.metal
    blocks = [n for count in shape for n in (count, samples)]
    return fine.reshape(blocks).mean(axis=(1, 3, 5)), metal.reshape(blocks).any(axis=(1, 3, 5))


def test_truth_is_the_mean_over_sample_points():
    values, shape = np.array([0.2, 0.6, 3.1]), (5, 9, 7)
    mu, metal = voxelise_truth(Phantom(nested()), values, shape, LOWER, UPPER, samples=8)
    mean, found = sampled(nested(), (0.2, 0.6, 3.1, 0.2), shape, 8, LOWER, UPPER)
    np.testing.assert_allclose(mu, mean, atol=1e-6)
    # Points on the faces find all that points far closer to each other do, where they miss it.
    finer = sampled(nested(), (0.2, 0.6, 3.1, 0.2), shape, 20, LOWER, UPPER)[1]
    assert metal[finer].all() and found.sum() < finer.sum() and metal.sum() < 1.2 * finer.sum()


@pytest.mark.parametrize("depth", [0.03, 0.08, 0.1])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_sliver_of_metal_in_a_voxel_counts(depth, axis):
    """A ball reaches ``depth`` of an edge beyond a voxel's face: a cap of pi h^2 (3 r - h) / 3."""
    shape, lower, upper = (9, 9, 9), np.full(3, -4.5), np.full(3, 4.5)
    radius, centre = 1.3, np.zeros(3)
    centre[axis] = 0.5 + depth - radius
    ball = Phantom([Part(ellipsoid(centre, radius), "iron", 7.9, metal=True)])
    mu, metal = voxelise_truth(ball, np.array([2.0]), shape, lower, upper)
    beyond = np.full(3, 4)
    beyond[axis] = 5
    cap = np.pi * depth**2 * (3 * radius - depth) / 3
    assert metal[tuple(beyond[::-1])]
    # Thinner than half the distance of the points, it is in the mask only.
    if depth > 0.5 / 9:
        assert mu[tuple(beyond[::-1])] == pytest.approx(2.0 * 7.9 * cap, rel=0.3)
    beyond[axis] = 6
    assert not metal[tuple(beyond[::-1])] and mu[tuple(beyond[::-1])] == 0


def test_what_ends_at_a_face_does_not_touch_the_next_voxel():
    block = Phantom([Part(box((0.5, 0.5, 0.5), (0.5, 1.5, 2.5)), "iron", 1.0, metal=True)])
    mu, metal = voxelise_truth(block, np.array([1.0]), (9, 9, 9), np.full(3, -4.0), np.full(3, 5.0))
    assert metal.sum() == mu.sum() == 1 * 3 * 5


@pytest.mark.parametrize("shape", [(12, 12, 12), (11, 17, 13)])
def test_mass_is_kept_and_sits_in_the_right_place(shape):
    ball = ellipsoid((0.3, -0.4, 0.2), 0.5)
    mu, _ = voxelise_truth(Phantom([Part(ball, "water", 1.0)]), np.array([1.0]), shape, LOWER, UPPER)
    voxel = (UPPER - LOWER) / np.array(shape[::-1])
    assert mu.sum() * voxel.prod() == pytest.approx(ball.volume, rel=2e-3)
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
