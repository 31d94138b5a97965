"""Losses in closed form."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tomo_polysplat.fit.loss import (
    away_from_edges,
    misfit,
    misfit_by_view,
    misfits_of_step,
    slope_of_variation,
    total_variation,
    variation_of_slab,
)
from tomo_polysplat.kernels.step.faint import HALO
from tomo_polysplat.settings import Settings

L1 = Settings(loss="l1")


def huber(width):
    """Settings of Huber's loss with its corner at this residual of a ray of weight 1."""
    return replace(Settings(loss="huber"), huber_corner=2.0, model_error=width / 2)


def uneven(seed=0, count=37):
    generator = torch.Generator().manual_seed(seed)
    predicted, measured = torch.rand((2, 3, 5, count), generator=generator, dtype=torch.float64)
    return predicted, measured, torch.rand((3, 5, count), generator=generator, dtype=torch.float64) + 0.1


def test_l1_is_the_weighted_mean_of_absolute_residuals():
    predicted, measured, weight = uneven()
    expected = np.average((predicted - measured).abs().numpy(), weights=weight.numpy())
    assert float(misfit(predicted, measured, weight, L1)) == pytest.approx(expected, rel=1e-12)


def test_a_constant_factor_of_all_weights_changes_nothing_for_l1():
    predicted, measured, weight = uneven()
    once, thrice = (float(misfit(predicted, measured, k * weight, L1)) for k in (1, 3))
    assert once == pytest.approx(thrice, rel=1e-12)


@pytest.mark.parametrize("settings", [L1, huber(0.1)])
def test_rays_without_weight_do_not_count(settings):
    predicted, measured, weight = uneven()
    weight[1] = 0
    expected = misfit(predicted[[0, 2]], measured[[0, 2]], weight[[0, 2]], settings)
    predicted[1] = 1e30
    assert float(misfit(predicted, measured, weight, settings)) == pytest.approx(float(expected), rel=1e-12)
    assert float(misfit(predicted, measured, 0 * weight, settings)) == 0


def test_huber_is_quadratic_within_the_corner_and_absolute_far_beyond():
    width, weight = 0.3, torch.tensor([0.5], dtype=torch.float64)
    corner = width / 0.5
    zero = torch.zeros(1, dtype=torch.float64)
    for residual in (0.01, 0.5 * corner, 0.999 * corner):
        value = float(misfit(zero + residual, zero, weight, huber(width)))
        assert value == pytest.approx(0.5 * (0.5 * residual) ** 2 / width / 0.5, rel=1e-9)
    far = float(misfit(zero + 1e4, zero, weight, huber(width)))
    assert far == pytest.approx(1e4, rel=1e-4), "the weighted mean of absolute residuals"


def test_huber_and_its_slope_are_continuous_at_the_corner():
    weight, width = torch.tensor([2.0], dtype=torch.float64), 0.3
    slopes = []
    for residual in (0.15 - 1e-9, 0.15 + 1e-9):
        x = torch.tensor([residual], dtype=torch.float64, requires_grad=True)
        misfit(x, torch.zeros_like(x), weight, huber(width)).backward()
        slopes.append(float(x.grad))
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-6) == pytest.approx(1.0, rel=1e-6)


def test_huber_tends_to_l1_as_its_corner_goes_to_zero():
    predicted, measured, weight = uneven()
    sharp = float(misfit(predicted, measured, weight, huber(1e-9)))
    assert sharp == pytest.approx(float(misfit(predicted, measured, weight, L1)), rel=1e-6)


def test_the_settings_choose_the_loss():
    rays = uneven()
    corner = Settings().huber_corner * Settings().model_error
    assert misfit(*rays, Settings(loss="huber")) == misfit(*rays, huber(corner))
    assert misfit(*rays, Settings(loss="huber")) != misfit(*rays, L1)


@pytest.mark.parametrize("loss", ["huber", "l1"])
def test_the_misfit_of_each_view_is_that_of_its_rays_alone(loss):
    predicted, measured, weight = uneven()
    weight[1], settings = 0, Settings(loss=loss)
    by_view = misfit_by_view(predicted, measured, weight, settings)
    alone = [float(misfit(*of_view, settings)) for of_view in zip(predicted, measured, weight)]
    assert by_view[[0, 2]].tolist() == pytest.approx([alone[0], alone[2]], rel=1e-12)
    assert math.isnan(by_view[1]), "no ray tells"


def test_total_variation_of_a_ramp_is_its_slopes():
    z, y, x = np.meshgrid(np.arange(5), np.arange(7), np.arange(4), indexing="ij")
    volume = torch.as_tensor(0.5 * z - 0.25 * y + 2.0 * x)
    assert float(total_variation(volume)) == pytest.approx(0.5 + 0.25 + 2.0)


def test_total_variation_of_a_cube_is_its_surface():
    """Faces of (side)^2 over the number of neighbours along each axis: the mean, summed over the axes."""
    volume = torch.zeros((9, 9, 9), dtype=torch.float64)
    volume[3:6, 3:6, 3:6] = 0.7
    assert float(total_variation(volume)) == pytest.approx(3 * 0.7 * 2 * 9 / (8 * 9 * 9))


@pytest.mark.parametrize("corners", [(0.0, 0.0), (0.2, 0.05), (0.29, 0.05)])
@pytest.mark.parametrize(("depth", "first", "last"), [(17, 0, 9), (17, 4, 14), (17, 0, 17), (1, 0, 1)])
def test_the_slope_of_a_slab_is_that_of_the_whole_but_where_it_ends(depth, first, last, corners):
    generator = torch.Generator().manual_seed(1)
    volume = torch.rand((depth, 4, 5), generator=generator, dtype=torch.float64)
    whole, slab = volume.clone().requires_grad_(), volume[first:last].clone().requires_grad_()
    total_variation(whole, corners, 0.6).backward()
    variation_of_slab(slab, depth, corners, 0.6).backward()
    beside = HALO if any(corners) else 1
    inner = slice(first + beside * (first > 0), last - beside * (last < depth))
    told = slab.grad[inner.start - first : inner.stop - first]
    torch.testing.assert_close(told, whole.grad[inner])
    assert bool(told.any())


def test_total_variation_of_one_slice_leaves_the_missing_axis_out():
    volume = torch.rand((1, 6, 8), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    stacked = volume.repeat(3, 1, 1)
    assert float(total_variation(volume)) == pytest.approx(float(total_variation(stacked)))
    assert float(total_variation(torch.full((1, 1, 1), 3.0))) == 0


def test_with_a_corner_noise_beside_an_edge_counts_in_full_and_the_edge_by_its_logarithm():
    edge = torch.tensor([1e-3, 0.0, 0.7], dtype=torch.float64)[None, None]
    assert float(total_variation(edge)) == pytest.approx((1e-3 + 0.7) / 2)
    found = float(total_variation(edge, (0.1, 0.1)))
    assert found == pytest.approx((1e-3 + 0.1 * math.log(8.0)) / 2, rel=1e-4)


@pytest.mark.parametrize(("wall", "faint"), [(8, 2), (7, 1), (6, 0)])
def test_faint_differences_count_squared_unless_an_edge_is_within_three_voxels(wall, faint):
    """By Huber's function with its corner at a half of theirs, in the logarithm; of two differences so many.

    In a volume: a slice has nothing faint.
    """
    column, corner, height = torch.zeros((13, 1, 1), dtype=torch.float64), 0.1, 0.02
    column[3], column[wall:] = height, 0.4
    squared, full, edge = (
        corner * math.log1p(counted / corner) for counted in (height**2 / corner, height, 0.4)
    )
    for some, values in ((faint, column), (0, column.transpose(0, 2))):
        expected = (some * squared + (2 - some) * full + edge) / 12
        assert float(total_variation(values, (corner, corner))) == pytest.approx(expected, rel=1e-12)


def test_nothing_dense_is_faint_nor_what_is_beside_it():
    row = torch.full((1, 1, 9), 3.0)
    assert not away_from_edges(row, 0.1, 2.2).any() and away_from_edges(row, 0.1, 3.0).all()
    row[..., 4] = 3.2
    assert away_from_edges(row, 0.1, 3.0)[0, 0].tolist() == [True] + [False] * 7 + [True]


@pytest.mark.parametrize("shape", [(1, 3, 5), (2, 1, 1), (9, 2, 3), (12, 13, 40)])
def test_what_a_step_finds_away_from_edges_is_what_torch_finds(shape):
    """Which has it in float64: blobs of faint matter, some of them dense, in no matter."""
    volume = torch.rand(shape, generator=torch.Generator().manual_seed(5))
    volume[volume < 0.02] = 2.0
    for corner in (0.2, 0.33, 0.7):
        assert torch.equal(
            away_from_edges(volume, corner, 1.5), away_from_edges(volume.double(), corner, 1.5)
        )


@pytest.mark.parametrize("rays", [3, 41, 40_009])
@pytest.mark.parametrize("loss", ["huber", "weighted-l1"])
def test_the_misfits_of_a_step_are_the_means_and_their_slopes(loss, rays):
    """In lanes of float32 as by autograd in float64; a ray without weight may have any prediction."""
    settings, random = replace(Settings(), loss=loss), torch.Generator().manual_seed(2)
    measured, weight = torch.rand((2, rays), generator=random)
    predicted = measured + 0.03 * torch.randn(rays, generator=random)
    held_out = torch.rand(rays, generator=random) < 0.2
    weight[::7], predicted[::5] = 0.0, measured[::5]
    parts = (predicted, measured, weight * ~held_out, weight * held_out)
    found = []
    for kind in (torch.float32, torch.float64):
        leaf, *rest = (part.to(kind, copy=True) for part in parts)
        fitted, *aside = misfits_of_step(leaf.requires_grad_(), *rest, settings)
        (3 * fitted).backward()
        means = torch.tensor([float(part) for part in (fitted.detach(), *aside)], dtype=torch.float64)
        found.append((means, leaf.grad.double()))
    for one, other in zip(*found):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6 * float(other.abs().max()))
    parts[0][::7] = math.nan
    again = misfits_of_step(*parts, settings)
    assert [float(part) for part in again] == pytest.approx(found[0][0].tolist(), rel=1e-6)


def test_the_pull_on_an_edge_falls_with_its_height():
    """The derivative of c log(1 + d / c) by d: 1 at a vanishing difference, a half at the corner."""
    pulls = []
    for height in (1e-9, 0.1, 0.9):
        row = torch.tensor([0.0, height, 9.0], dtype=torch.float64)[None, None].requires_grad_()
        total_variation(row, (0.1, 0.1)).backward()
        pulls.append(-2 * float(row.grad[0, 0, 0]))
    assert pulls == pytest.approx([1.0, 0.5, 0.1])


@pytest.mark.parametrize("corners", [(0.0, 0.0), (0.3, 0.3), (0.5, 0.05)])
@pytest.mark.parametrize("depth", [1, 4])
def test_the_slope_of_the_total_variation_is_that_of_its_values(depth, corners):
    """By finite differences, in faint matter, at its edges and at dense matter."""
    volume = 0.3 * torch.rand((depth, 4, 9), generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    volume[..., 6:] += 0.7
    value = lambda v: total_variation(v, corners, 0.6)  # noqa: E731
    assert torch.autograd.gradcheck(value, volume.requires_grad_(), eps=1e-7, atol=1e-6)


@pytest.mark.parametrize("corners", [(0.0, 0.0), (0.1, 0.1), (0.1, 0.3)])
@pytest.mark.parametrize("shape, planes", [((1, 7, 9), 1), ((6, 9, 8), 6), ((6, 9, 8), 20), ((4, 1, 9), 4)])
def test_the_slope_that_a_step_takes_is_that_of_autograd(shape, planes, corners):
    """Of whole volumes and of slabs: flat parts, faint and plain edges, and dense matter."""
    random = torch.Generator().manual_seed(3)
    volume = (2 * torch.rand(shape, generator=random) - 0.5).clamp(min=0)
    volume[..., : shape[2] // 2] = 1 + 0.002 * torch.rand((*shape[:2], shape[2] // 2), generator=random)
    found = slope_of_variation(volume, planes, corners, 1.2, 0.07)
    leaf = volume.clone().requires_grad_()
    (0.07 * variation_of_slab(leaf * 1, planes, corners, 1.2)).backward()
    torch.testing.assert_close(found, leaf.grad, rtol=0, atol=1e-6 * float(leaf.grad.abs().max()))
    assert found.count_nonzero() > found.numel() / 4
    double = slope_of_variation(volume.double(), planes, corners, 1.2, 0.07)
    torch.testing.assert_close(found.double(), double, rtol=1e-4, atol=1e-6 * float(double.abs().max()))


def test_metal_pays_for_its_mottles_and_by_the_logarithm_for_its_brightness():
    volume = torch.zeros((1, 8, 8), dtype=torch.float64)
    volume[0, 1:7, 1:7] = 10.0
    mottled = volume.clone()
    mottled[0, 2:6:2, 2:6:2] += 3.0
    smooth, brighter, uneven = (float(total_variation(v, (0.1, 0.1))) for v in (volume, 10 * volume, mottled))
    # 24 of the 56 differences along each axis are at the surface, and 16 of both axes beside the mottles.
    assert brighter - smooth == pytest.approx(0.1 * math.log(1001 / 101) * 24 / 56)
    assert uneven - smooth == pytest.approx(0.1 * math.log(31) * 16 / 56)
