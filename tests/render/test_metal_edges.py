"""What a solid's Gaussians spill over its surface goes back inside, and nothing else is moved."""

import numpy as np
import pytest
import torch

from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.render import renderer
from tomo_polysplat.render.metal_edges import tail_factors, tails
from tomo_polysplat.render.renderer import voxelise_gaussians, voxelise_means, voxelise_peaks

KERNEL = "numba"
# Edge of a voxel, and distance and deviation of the Gaussians that fill a solid, in voxels.
VOXEL, STEP, DEVIATION = 0.1, 0.2, 0.3


def box(planar, count=11):
    shape = (1 if planar else count, count, count)
    first = np.array([0.0 if n == 1 else 0.5 * VOXEL for n in shape[::-1]])
    return VoxelBox(first, np.full(3, VOXEL), shape)


def block(planar, low, high):
    """Gaussians that fill a square or cube from ``low`` to ``high``, counted in voxels."""
    line = torch.arange(low + STEP / 2, high, STEP) * VOXEL
    axes = (line, line, torch.zeros(1) if planar else line)
    position = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)
    count, dims = len(position), 2 if planar else 3
    rotation = torch.zeros(count, 4)
    rotation[:, 0] = 1
    return Gaussians(
        position,
        torch.full((count, dims), float(np.log(DEVIATION * VOXEL))),
        rotation,
        torch.ones(count),
        torch.zeros(count),
        torch.zeros(2),
        torch.ones(count, dtype=torch.int64),
        torch.zeros(1),
    )


def found(gaussians, where, level=0.5):
    weights = gaussians.weights(None)
    metal = voxelise_means(gaussians, weights, where, KERNEL)[0]
    return metal, tails(metal, gaussians, weights, where, KERNEL, level)


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize(
    ("end", "outside"), [(7.0, 7), (7.3, 8), (7.6, 8), (8.0, 8)], ids=["at 7", "7.3", "7.6", "at 8"]
)
def test_a_voxel_that_the_solid_enters_is_no_tail_and_the_next_is(planar, end, outside):
    """Along the line through the middle of the solid, which ends at ``end`` voxels."""
    metal, tail = found(block(planar, 3.0, end), box(planar))
    middle = 0 if planar else 5
    assert not bool(tail[middle, 5, 3:outside].any())
    assert float(tail[middle, 5, outside]) == (float(metal[middle, 5, outside]) > 0)
    assert float(tail[middle, 5, 2]) == 1 and not bool(tail[metal == 0].any())


@pytest.mark.parametrize("planar", [True, False])
def test_a_solid_keeps_its_mass_and_loses_its_halo(planar):
    metal, tail = found(block(planar, 3.0, 8.0), box(planar))
    clean = metal * tail_factors(metal, torch.zeros_like(metal), tail)
    inside = (slice(None) if planar else slice(3, 8), slice(3, 8), slice(3, 8))
    assert float(clean.sum()) == pytest.approx(float(metal.sum()), rel=1e-5)
    assert float(clean[inside].sum()) == pytest.approx(float(clean.sum()), rel=1e-5)
    assert float(metal[inside].sum()) < 0.95 * float(metal.sum())


def test_a_voxel_that_the_solid_hardly_enters_gives_away_a_part_and_the_mass_is_kept():
    """Ever less of it the further the solid reaches in: nothing hangs on a hair."""
    shares = []
    for further in (0.0, 0.08, 0.12, 0.2):
        metal, tail = found(block(False, 3.0 + further, 7.0 + further), box(False))
        shares.append(float(tail[5, 5, 7]))
        moved = metal * tail_factors(metal, torch.ones_like(metal), tail)
        assert float(moved.sum()) == pytest.approx(float(metal.sum()), rel=1e-5)
    assert shares[0] == 1 and shares[-1] == 0 and 1 > shares[1] > shares[2] > 0, shares


@pytest.mark.parametrize("planar", [True, False])
def test_a_lighter_metal_beside_a_dense_one_stays_and_loses_its_own_halo(planar):
    """As titanium does beside steel: it ends at 9 voxels, the dense one at 6."""
    both = block(planar, 3.0, 9.0)
    both.attenuation[both.position[:, 0] > 6.0 * VOXEL] = 0.35
    metal, tail = found(both, box(planar, 13))
    middle = 0 if planar else 6
    assert not bool(tail[middle, 6, 3:9].any())
    assert float(tail[middle, 6, 9]) == 1 and float(tail[middle, 6, 2]) == 1


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("deviation", [0.3, 0.35])
def test_what_lies_between_two_pieces_of_one_metal_is_tails(planar, deviation):
    """Of two voxels between them each holds as much as the other, but of the Gaussians of the pieces."""
    both = block(planar, 3.0, 10.0)
    both.log_scale += np.log(deviation / DEVIATION)
    x = both.position[:, 0] / VOXEL
    metal, tail = found(both.select(((x < 6.0) | (x > 8.0)).nonzero()[:, 0]), box(planar, 13))
    gap = metal[0 if planar else 6, 6, 6:8]
    assert float(gap.min()) > 0.7 * float(gap.max())
    assert bool((tail[0 if planar else 6, 6, 6:8] == 1).all())


@pytest.mark.parametrize("planar", [True, False])
def test_without_a_level_or_metal_there_are_no_tails(planar):
    assert not bool(found(block(planar, 3.0, 7.0), box(planar), level=0.0)[1].any())
    empty = block(planar, 3.0, 7.0).select(torch.zeros(0, dtype=torch.int64))
    metal, tail = found(empty, box(planar))
    assert not bool(tail.any()) and bool((tail_factors(metal, metal, tail) == 1).all())


@pytest.mark.parametrize("planar", [True, False])
def test_peaks_are_the_largest_of_what_is_sampled(planar):
    gaussians, where = block(planar, 3.0, 6.4), box(planar)
    weights = gaussians.weights(None)
    peaks = voxelise_peaks(gaussians, weights, where, KERNEL)
    centres = voxelise_gaussians(gaussians, weights, where, KERNEL)
    assert peaks.shape == centres.shape and bool((peaks >= centres * (1 - 1e-5)).all())
    highest = voxelise_gaussians(
        gaussians, weights, where.refined(np.array([1 if planar else 5, 5, 5])), KERNEL
    )
    assert float(peaks.max()) == pytest.approx(float(highest.max()), rel=1e-6)


@pytest.mark.parametrize("shape", [(1, 9, 8), (2, 9, 8), (7, 9, 8), (2, 2, 2), (1, 1, 3)])
def test_tails_of_metal_go_back_inside_it(shape):
    metal, rest = torch.zeros(shape), torch.ones(shape)
    centre = tuple(n // 2 for n in shape)
    left = (centre[0], centre[1], centre[2] - 1)
    metal[centre], metal[left] = 10.0, 0.5
    moved = metal * tail_factors(metal, rest, (metal == 0.5).float())
    assert float(moved[left]) == 0 and float(moved[centre]) == pytest.approx(10.5)
    assert bool((tail_factors(metal, rest, torch.zeros(shape)) == 1).all())


def test_a_tail_fills_what_the_fit_has_dug_for_it():
    """The rays see the sum: a voxel whose soft matter makes room for a tail is soft matter."""
    metal, rest = torch.zeros(5, 6, 7), torch.ones(5, 6, 7)
    metal[2, 3, 3], metal[2, 3, 4], rest[2, 3, 4] = 10.0, 0.5, 0.7
    volume = rest + metal * tail_factors(metal, rest, (metal == 0.5).float())
    assert float(volume[2, 3, 4]) == pytest.approx(1.0)
    assert float(volume.sum()) == pytest.approx(float((rest + metal).sum()))


def test_what_is_no_tail_stays():
    metal, gaussians = torch.full((4, 5, 6), 2.0), block(False, 3.0, 7.0)
    where = VoxelBox(np.zeros(3), np.full(3, VOXEL), (4, 5, 6))
    tail = tails(metal, gaussians, gaussians.weights(None), where, KERNEL, 0.5)
    assert torch.allclose(tail_factors(metal, torch.ones_like(metal), tail), torch.ones_like(metal))


def test_a_crumb_of_metal_does_not_get_what_is_more_than_itself():
    metal, rest = torch.zeros(5, 6, 7), torch.ones(5, 6, 7)
    metal[2, 3, 3], metal[2, 3, 4] = 0.1, 0.5
    assert bool((tail_factors(metal, rest, (metal == 0.5).float()) == 1).all())


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("room", [1, 3000, 1 << 25])
def test_samples_are_the_same_in_parts_of_any_size(planar, room, monkeypatch):
    """From a row of voxels at a time to all of the volume."""
    gaussians, where = block(planar, 3.0, 6.4), box(planar)
    weights = gaussians.weights(None)
    whole = [f(gaussians, weights, where, KERNEL) for f in (voxelise_peaks, voxelise_means)]
    monkeypatch.setattr(renderer, "_SLAB", room)
    parts = [f(gaussians, weights, where, KERNEL) for f in (voxelise_peaks, voxelise_means)]
    for one, other in zip(whole, parts):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)
