"""Seeds against the volume they are made from."""

import math

import numpy as np
import pytest
import torch

from tomo_polysplat.model.seed import Spacing, seed_gaussians
from tomo_polysplat.scan.geometry import VolumeGrid
from tomo_polysplat.settings import Settings

SETTINGS = Settings()


def grid_of(shape, voxel=(0.1, 0.1, 0.1), shift=(0.0, 0.0, 0.0)):
    half = 0.5 * np.array(shape[::-1]) * np.array(voxel)
    return VolumeGrid(shape, np.array(shift) - half, np.array(shift) + half)


def seeds(start, grid, spacing=1.3, polychromatic=False, settings=SETTINGS, finer=0.0):
    planar = grid.planar
    distance = spacing * float(grid.voxel_size[: 2 if planar else 3].min())
    return seed_gaussians(
        torch.tensor(start), grid, Spacing(distance, finer), settings, polychromatic, planar
    )


def mass(cloud, dims):
    """Integral of the Gaussians in closed form, over an area when planar."""
    volume = cloud.log_scale[:, :dims].sum(dim=1).exp() * (2 * math.pi) ** (dims / 2)
    return float((cloud.attenuation * volume).double().sum())


def smooth_ball(grid, radius=0.7):
    z, y, x = np.meshgrid(*grid.axes()[::-1], indexing="ij")
    (x, y, z), scale = (a - c for a, c in zip((x, y, z), grid.centre)), 0.5 * grid.extent
    r = np.sqrt((x / scale[0]) ** 2 + (y / scale[1]) ** 2 + (0 if grid.planar else (z / scale[2]) ** 2))
    return (1 / (1 + np.exp((r - radius) / 0.05))).astype(np.float32)


@pytest.mark.parametrize(
    "shape, voxel",
    [
        ((21, 21, 21), (0.1, 0.1, 0.1)),
        ((24, 19, 31), (0.1, 0.1, 0.1)),
        ((9, 25, 27), (0.1, 0.1, 0.5)),
        ((40, 20, 20), (0.2, 0.1, 0.05)),
        ((1, 33, 29), (0.1, 0.1, 0.1)),
    ],
)
@pytest.mark.parametrize("spacing, tolerance", [(1.0, 0.04), (1.3, 0.06), (2.1, 0.2)])
def test_seeds_have_the_mass_of_the_start(shape, voxel, spacing, tolerance):
    grid = grid_of(shape, voxel)
    start = smooth_ball(grid)
    dims = 2 if grid.planar else 3
    expected = float(start.sum()) * float(np.prod(grid.voxel_size[:dims]))
    # A lattice samples a smooth ball; what is faint is raised to where it can grow, or dropped.
    assert mass(seeds(start, grid, spacing), dims) == pytest.approx(expected, rel=tolerance)


def test_seeds_of_a_full_window_have_its_mass_to_rounding():
    for shape in ((7, 11, 13), (1, 10, 17)):
        grid = grid_of(shape)
        dims = 2 if grid.planar else 3
        expected = float(np.prod(grid.extent[:dims]))
        assert mass(seeds(np.ones(shape, np.float32), grid), dims) == pytest.approx(expected, rel=1e-5)


def test_one_slice_of_a_scan_with_several_rows_gets_gaussians_that_end():
    grid = grid_of((1, 9, 9))
    cloud = seed_gaussians(torch.ones(1, 9, 9), grid, Spacing(0.13), SETTINGS, False, False)
    assert not cloud.planar and bool(torch.isfinite(cloud.scale()).all())
    assert mass(cloud, 3) == pytest.approx(float(np.prod(grid.extent)), rel=1e-5)


def test_air_gets_none():
    grid = grid_of((20, 20, 20), shift=(3.0, -1.0, 0.5))
    start = smooth_ball(grid, 0.4)
    cloud = seeds(start, grid)
    distance = (cloud.position - torch.tensor([3.0, -1.0, 0.5])).norm(dim=1)
    assert len(cloud) > 0 and float(distance.max()) < 0.4 + 0.15 + 3 * 0.13
    assert len(seeds(np.zeros((20, 20, 20), np.float32), grid)) == 0
    assert len(seeds(-np.ones((20, 20, 20), np.float32), grid)) == 0


def test_seeds_carry_the_value_of_the_place_they_lie_at():
    grid = grid_of((1, 30, 30))
    x = grid.axes()[0]
    start = np.broadcast_to((1.5 + x).astype(np.float32), grid.shape)
    cloud = seeds(start, grid, 1.0)
    height = cloud.attenuation * 2 * math.pi * SETTINGS.seed_width**2
    assert np.allclose(height.numpy(), 1.5 + cloud.position[:, 0].numpy(), atol=0.06)


def with_metal(shape=(16, 16, 16)):
    start = np.ones(shape, np.float32)
    start[4:6, 4:6, 4:6] = 20.0
    start[11:13, 11:13, 11:13] = 30.0
    return start, grid_of(shape)


def test_metal_gets_seeds_half_as_far_apart_and_keeps_its_mass():
    start, grid = with_metal()
    plain, fine = seeds(np.ones_like(start), grid), seeds(start, grid)
    assert len(fine) > len(plain)
    assert float(fine.log_scale.min()) == pytest.approx(float(plain.log_scale.min()) - math.log(2), abs=1e-5)
    assert mass(fine, 3) == pytest.approx(float(start.sum()) * 1e-3, rel=0.15)


@pytest.mark.parametrize("shape", [(15, 17, 61), (1, 47, 51)])
def test_seeds_are_finer_where_the_start_varies_and_no_more_of_them(shape):
    grid = grid_of(shape)
    dims = 2 if grid.planar else 3
    start = np.ones(shape, np.float32)
    start[..., shape[-1] // 2 :] = 1.5
    edge = float(grid.lower[0] + (shape[-1] // 2) * grid.voxel_size[0])
    even, uneven = seeds(start, grid, 2.0), seeds(start, grid, 2.0, finer=0.5)
    # Whole numbers of cells fill the window.
    assert 0.8 * len(even) < len(uneven) < 1.1 * len(even)
    assert mass(uneven, dims) == pytest.approx(mass(even, dims), rel=0.02)
    near = (uneven.position[:, 0] - edge).abs() < 0.1
    assert bool(near.any()) and bool((~near).any())
    widths = uneven.scale()[:, 0]
    assert float(widths[near].max()) < 0.6 * float(widths.max())
    assert float(widths.max()) > 1.2 * float(even.scale()[:, 0].max())


def test_every_piece_of_metal_shares_one_number_of_its_own():
    start, grid = with_metal()
    cloud = seeds(start, grid, 1.0, polychromatic=True)
    assert len(cloud.shared_material) == 3
    position = cloud.position.numpy()
    for piece, low in ((1, 4), (2, 11)):
        members = position[cloud.group.numpy() == piece]
        lower, upper = grid.lower + 0.1 * low, grid.lower + 0.1 * (low + 2)
        assert len(members) and (members > lower).all() and (members < upper).all()
    assert cloud.material()[cloud.group > 0].unique().tolist() == pytest.approx([SETTINGS.metal_u])


def test_soft_matter_far_from_metal_shares_a_number_and_near_it_has_its_own():
    start = np.ones((1, 60, 60), np.float32)
    start[0, 10:12, 10:12] = 20.0
    cloud = seeds(start, grid_of((1, 60, 60)), 1.0, polychromatic=True)
    # In voxels from the middle of the metal along the farther axis.
    distance = (cloud.position[:, :2] - torch.tensor([-1.9, -1.9])).abs().amax(dim=1) / 0.1
    far, near = distance > SETTINGS.free_radius + 3, (distance > 3) & (distance < SETTINGS.free_radius - 1)
    assert bool(far.any()) and bool(near.any())
    assert bool((cloud.group[far] == 0).all()) and bool((cloud.group[near] == -1).all())


def test_a_monochromatic_cloud_has_one_group():
    start, grid = with_metal()
    cloud = seeds(start, grid)
    assert bool((cloud.group == 0).all()) and len(cloud.shared_material) == 1


def test_the_start_is_not_written_to():
    start, grid = with_metal()
    before = start.copy()
    start.flags.writeable = False
    seeds(start, grid, polychromatic=True)
    assert np.array_equal(start, before)


@pytest.mark.gpu
def test_seeds_on_the_gpu_are_those_of_the_cpu():
    grid = grid_of((24, 19, 31))
    start = np.zeros(grid.shape, np.float32)
    start[3:21, 4:16, 5:27] = 1.0
    start[9:13, 7:11, 8:13], start[15, 12, 20:23] = 9.0, 3.0
    clouds = [
        seed_gaussians(torch.tensor(start, device=device), grid, Spacing(0.17), SETTINGS, True, False)
        for device in ("cpu", "cuda")
    ]
    assert len(clouds[0]) == len(clouds[1]) and torch.equal(clouds[0].group, clouds[1].group.cpu())
    for name, expected in clouds[0].parameters().items():
        torch.testing.assert_close(clouds[1].parameters()[name].cpu(), expected, rtol=1e-5, atol=1e-6)


def test_metal_may_reach_down_to_its_rim_where_it_is_connected():
    start = np.ones((1, 40, 40), np.float32)
    start[0, 8:16, 8:16], start[0, 10:14, 10:14] = 3.0, 4.0
    start[0, 28:32, 28:32] = 3.0
    grid = grid_of(start.shape)
    for rim, first, last in ((None, 10, 14), (2.5, 8, 16)):
        settings = Settings(metal_level=3.5, metal_u=1.0, metal_rim=rim)
        cloud = seeds(start, grid, 1.0, polychromatic=True, settings=settings)
        place = cloud.position[:, :2] / 0.1 + 20
        inside = ((place > first) & (place < last)).all(dim=1)
        assert int(inside.sum()) >= (last - first) ** 2
        assert len(cloud.shared_material) == 2 and torch.equal(cloud.group == 1, inside)
