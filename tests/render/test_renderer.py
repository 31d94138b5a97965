"""Rays and voxels show the same Gaussians."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tomo_polysplat.kernels.project.autograd import project
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.render.renderer import (
    RAY_CUTOFF,
    VOXEL_CUTOFF,
    detector_views,
    project_gaussians,
    voxel_box,
    voxelise_gaussians,
    voxelise_means,
)
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid

KERNEL = "numba"


def inside(radius):
    """Share of a 3D Gaussian's mass within ``radius`` deviations."""
    return math.erf(radius / math.sqrt(2)) - math.sqrt(2 / math.pi) * radius * math.exp(-(radius**2) / 2)


def test_voxels_and_rays_cut_the_same_share_of_a_gaussian():
    """A projection cut at c deviations loses exp(-c^2/2) of a two-dimensional Gaussian."""
    assert inside(VOXEL_CUTOFF) == pytest.approx(1 - math.exp(-(RAY_CUTOFF**2) / 2), abs=1e-6)


def cloud(dims=3, count=40, seed=0, widest=0.12, narrowest=0.06):
    rng = np.random.default_rng(seed)
    position = rng.uniform(-0.4, 0.4, (count, 3))
    if dims == 2:
        position[:, 2] = 0
    rotation = rng.standard_normal((count, 4))
    if dims == 2:
        rotation[:, 1:3] = 0  # about z alone

    def tensor(array):
        return torch.as_tensor(array, dtype=torch.float32)

    return Gaussians(
        tensor(position),
        tensor(np.log(rng.uniform(narrowest, widest, (count, dims)))),
        tensor(rotation),
        tensor(rng.uniform(0.5, 2.0, count)),
        torch.zeros(count),
        torch.zeros(1),
        torch.zeros(count, dtype=torch.int64),
        torch.zeros(1),
    )


def mass(gaussians):
    dims = gaussians.log_scale.shape[1]
    width = gaussians.log_scale.sum(dim=1).exp() * (2 * math.pi) ** (dims / 2)
    return float((gaussians.attenuation * width).double().sum())


def parallel(planar=False, pixels=61, step=0.05):
    angles = np.array([0.0, 0.7, 1.9])
    u = step * np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)
    v = step * np.tile([0.0, 0, 1], (3, 1))
    rows = 1 if planar else pixels
    origin = np.stack([-np.sin(angles), np.cos(angles), 0 * angles], 1)
    corner = -0.5 * (pixels - 1) * u - 0.5 * (rows - 1) * v
    return Geometry("parallel", origin, corner, u, v, rows, pixels)


def cube(size, planar=False, half=1.0):
    thick = half / size if planar else half
    return VolumeGrid((1 if planar else size, size, size), [-half, -half, -thick], [half, half, thick])


@pytest.mark.parametrize("planar", [False, True])
def test_every_view_and_the_volume_hold_the_mass_of_the_gaussians(planar):
    gaussians = cloud(2 if planar else 3)
    weights, expected = gaussians.weights(None), mass(gaussians)
    image, skipped = project_gaussians(gaussians, weights, detector_views(parallel(planar), planar), KERNEL)
    area = 0.05 if planar else 0.05**2
    sums = image[0].double().sum(dim=(1, 2)) * area
    cell = (2 / 50) ** (2 if planar else 3)
    volume = voxelise_gaussians(gaussians, weights, voxel_box(cube(50, planar)), KERNEL)
    # In 3D both are cut where exp(-9/2) is missing; lines and planes of a 2D one a little differently.
    kept = 1.0 if planar else 1 - math.exp(-4.5)
    assert skipped == 0
    assert sums.tolist() == pytest.approx([kept * expected] * 3, rel=4e-3)
    assert float(volume.double().sum()) * cell == pytest.approx(kept * expected, rel=4e-3)


def test_a_ray_is_the_line_integral_of_the_voxels():
    """The view along y of a fine volume is its sum along y."""
    gaussians = cloud()
    weights = gaussians.weights(None)
    size = 61
    half = 0.5 * size * 0.05
    drawn = gaussians.position, gaussians.scale(), gaussians.rotation, weights
    image, _ = project(*drawn, detector_views(parallel(), False), kernel=KERNEL, cutoff=6.0)
    volume = voxelise_gaussians(gaussians, weights, voxel_box(cube(size, half=half)), KERNEL)
    along_y = volume[0].double().sum(dim=1) * 0.05
    error = (along_y - image[0, 0].double()).abs().max() / image[0, 0].abs().max()
    # Of what the voxels cut at 3.33 deviations a ray through the middle of a Gaussian misses next to nothing.
    assert float(error) < 0.01


def test_means_over_voxels_are_means_of_finer_voxels():
    gaussians = cloud(widest=0.05, narrowest=0.03)
    weights = gaussians.weights(None)
    means = voxelise_means(gaussians, weights, voxel_box(cube(16)), KERNEL)[0]
    fine = voxelise_gaussians(gaussians, weights, voxel_box(cube(80)), KERNEL)[0]
    expected = fine.reshape(16, 5, 16, 5, 16, 5).mean(dim=(1, 3, 5))
    assert float((means - expected).norm() / expected.norm()) < 0.04
    centres = voxelise_gaussians(gaussians, weights, voxel_box(cube(16)), KERNEL)[0]
    assert float((centres - expected).norm() / expected.norm()) > 0.1, "else there was nothing to do"


@pytest.mark.parametrize("shape", [(2, 16, 16), (16, 1, 16), (1, 1, 1)])
def test_means_over_oblong_and_over_huge_voxels(shape):
    """A voxel many deviations long is sampled as finely as its Gaussians are thin."""
    gaussians = cloud(widest=0.09, narrowest=0.06)
    weights = gaussians.weights(None)
    grid = VolumeGrid(shape, [-1.0, -1.0, -1.0], [1.0, 1.0, 1.0])
    means = voxelise_means(gaussians, weights, voxel_box(grid), KERNEL)[0]
    fine = voxelise_gaussians(gaussians, weights, voxel_box(cube(80)), KERNEL)[0]
    blocks = [n for pair in ((n, 80 // n) for n in shape) for n in pair]
    expected = fine.reshape(blocks).mean(dim=(1, 3, 5))
    # Of which 0.9 % are the three samples along the short edges.
    assert float((means - expected).norm() / expected.norm()) < 0.02


def test_means_of_gaussians_of_all_widths_at_the_border():
    """Those that are thinner are sampled by themselves, at more points, and only where they are."""
    gaussians = cloud(count=60, widest=0.06, narrowest=0.006)
    gaussians.position[:] *= 2.4
    weights = gaussians.weights(None)
    means = voxelise_means(gaussians, weights, voxel_box(cube(16)), KERNEL)[0]
    fine = voxelise_gaussians(gaussians, weights, voxel_box(cube(240)), KERNEL)[0]
    expected = fine.reshape(16, 15, 16, 15, 16, 15).mean(dim=(1, 3, 5))
    # With three samples a voxel for all of them it is 0.057.
    assert float((means - expected).norm() / expected.norm()) < 0.045


def test_gaussians_beside_the_volume_leave_it_empty():
    gaussians = cloud(widest=0.05, narrowest=0.01)
    gaussians.position[:, 0] += 3.0
    assert not bool(voxelise_means(gaussians, gaussians.weights(None), voxel_box(cube(16)), KERNEL).any())


@pytest.mark.parametrize("shape", [(20, 20, 20), (20, 18, 6), (1, 20, 12)])
def test_means_of_wide_gaussians_are_means_of_finer_voxels(shape):
    """By a wider Gaussian at the centre: of 0.6 to 1.2 of the longest edge, turned any way."""
    edge = 2 / min(n for n in shape if n > 1)
    gaussians = cloud(2 if shape[0] == 1 else 3, widest=1.2 * edge, narrowest=0.6 * edge)
    weights = gaussians.weights(None)
    grid, finer = (
        VolumeGrid(n, [-1.0] * 3, [1.0] * 3) for n in (shape, [5 * n if n > 1 else 1 for n in shape])
    )
    centres, means = (
        f(gaussians, weights, voxel_box(grid), KERNEL)[0] for f in (voxelise_gaussians, voxelise_means)
    )
    fine = voxelise_gaussians(gaussians, weights, voxel_box(finer), KERNEL)[0]
    expected = fine.reshape([n for pair in zip(shape, finer.shape) for n in (pair[0], pair[1] // pair[0])])
    expected = expected.mean(dim=(1, 3, 5))
    assert float((means - expected).norm() / expected.norm()) < 0.01
    assert float((centres - expected).norm() / expected.norm()) > 0.02, "else there was nothing to do"


def test_a_coarse_cloud_is_not_blurred_once_more():
    gaussians = cloud()
    weights, box = gaussians.weights(None), voxel_box(cube(20), distance=1.8)
    centres, means = (f(gaussians, weights, box, KERNEL) for f in (voxelise_gaussians, voxelise_means))
    assert bool(centres.any()) and torch.allclose(centres, means, rtol=1e-5)
    assert voxel_box(cube(20), distance=1.3).whole


def rays_through_slices(rows_a_slice, tilt=0.0):
    """A parallel beam through slices of 0.1, with so many rows each, that rises by ``tilt`` on a unit of its way."""
    zero, one = np.zeros((3, 1)), np.ones((3, 1))
    u, v = np.hstack([one, zero, zero]), np.hstack([zero, zero, one]) * 0.1 / rows_a_slice
    return Geometry("parallel", np.hstack([zero, one, tilt * one]), -10 * u - v, u, v, 20 * rows_a_slice, 20)


def test_slices_show_the_values_at_their_centres():
    """What lies between rows is not measured, and round seeds are blurred enough; two rows a slice see all of it."""
    grid, ray = cube(20), rays_through_slices(1)
    assert voxel_box(grid).whole and not voxel_box(grid, ray).whole
    assert voxel_box(grid, rays_through_slices(2)).whole
    assert voxel_box(grid, rays_through_slices(1, tilt=0.1)).whole
    u, v = np.array([[0.1, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.1]])
    fan = Geometry("cone", np.array([[0.0, -10.0, 0.0]]), -10 * u, u, v, 1, 20)
    assert not voxel_box(cube(20, planar=True), fan).whole and voxel_box(grid, fan).whole
    gaussians = cloud()
    weights = gaussians.weights(None)
    centres, shown = (
        f(gaussians, weights, voxel_box(grid, ray), KERNEL) for f in (voxelise_gaussians, voxelise_means)
    )
    of_voxels = voxelise_means(gaussians, weights, voxel_box(grid), KERNEL)
    assert float((shown - centres).norm() / centres.norm()) < 1e-5
    assert float((of_voxels - centres).norm() / centres.norm()) > 0.03


@pytest.mark.parametrize("slices", [1, 3, 7])
def test_slices_show_what_their_rays_see_of_thin_gaussians(slices):
    """Discs in the middle of each slice, thinner than it: a ray meets all of their density; of two rays each a part."""
    half = 0.05 * slices
    grid = VolumeGrid((slices, 20, 20), [-1.0, -1.0, -half], [1.0, 1.0, half])
    discs = cloud(count=slices)
    discs.position[:] = (
        torch.tensor([[0.05, 0.05, 0.05 - half]]) + 0.1 * torch.arange(slices)[:, None] * torch.eye(3)[2]
    )
    discs.log_scale[:] = torch.tensor([0.4, 0.4, 0.02]).log()
    discs.rotation[:] = torch.eye(4)[0]
    rays = rays_through_slices(1)
    rays = replace(rays, corner=rays.corner + [0.0, 0.0, 0.15 - half])
    seen = voxel_box(grid, rays)
    assert not voxel_box(grid, replace(rays, corner=rays.corner + [0.0, 0.0, 0.03])).levels, (
        "rows beside the middle"
    )
    assert not voxel_box(grid, replace(rays, u=rays.u + [0.0, 0.0, 0.001])).levels, "a rolled detector"
    shown = [
        voxelise_means(discs, torch.ones(1, slices), box, KERNEL)[0, :, 10, 10]
        for box in (seen, replace(seen, levels=2), voxel_box(grid))
    ]
    expected = [
        1.0,
        math.exp(-0.5 * (0.025 / 0.02) ** 2),
        0.2 * math.sqrt(2 * math.pi) * math.erf(2.5 / math.sqrt(2)),
    ]
    for values, value in zip(shown, expected):
        assert values.tolist() == pytest.approx([value] * slices, rel=0.03)


@pytest.mark.parametrize("planar", [False, True])
def test_means_keep_the_mass_of_gaussians_thinner_than_a_voxel(planar):
    gaussians = cloud(2 if planar else 3, widest=0.03, narrowest=0.02)
    weights = gaussians.weights(None)
    # Voxels of 0.08: samples at their centres would be off by far more.
    volume = voxelise_means(gaussians, weights, voxel_box(cube(25, planar)), KERNEL)
    cell = 0.08 ** (2 if planar else 3)
    assert float(volume.double().sum()) * cell == pytest.approx(mass(gaussians), rel=0.05)


def test_no_gaussians_are_a_volume_of_zeros():
    gaussians = cloud().select(torch.zeros(0, dtype=torch.int64))
    for voxelise in (voxelise_gaussians, voxelise_means):
        volume = voxelise(gaussians, gaussians.weights(None), voxel_box(cube(5)), KERNEL)
        assert volume.shape == (1, 5, 5, 5) and not bool(volume.any())
