"""Relocation and growth: what moves or is split, and that nothing of the object is lost by it."""

import math

import numpy as np
import pytest
import torch

from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.model.density_control import grow, relocate, splittable
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.render.renderer import voxelise_gaussians


def cloud(attenuation, group=-1):
    count = len(attenuation)
    generator = torch.Generator().manual_seed(3)
    return Gaussians(
        position=0.5 * torch.rand((count, 3), generator=generator) - 0.25,
        log_scale=torch.log(0.05 + 0.1 * torch.rand((count, 3), generator=generator)),
        rotation=torch.randn((count, 4), generator=generator),
        attenuation=torch.as_tensor(attenuation, dtype=torch.float32),
        own_material=torch.linspace(0, 0.5, count),
        shared_material=torch.zeros(1),
        group=torch.full((count,), group),
        blur=torch.zeros(1),
    )


def volume(gaussians):
    box = VoxelBox(np.full(3, -0.98), np.full(3, 0.04), (50, 50, 50))
    return voxelise_gaussians(gaussians, gaussians.weights(None), box, "numba")[0].double()


def all_of(gaussians):
    return torch.ones(len(gaussians), dtype=torch.bool)


def test_the_hardest_pulled_is_split_into_the_dead_ones_place():
    gaussians = cloud([1.0, 0.0, 2.0, 0.5])
    before = gaussians.copy()
    changed = relocate(gaussians, torch.tensor([0.1, 9.0, 3.0, 0.2]), 0.5, all_of(gaussians))
    assert sorted(changed.tolist()) == [1, 2]
    for index in (0, 3):
        assert torch.equal(gaussians.position[index], before.position[index])
    assert gaussians.own_material[1] == before.own_material[2]
    middle = 0.5 * (gaussians.position[1] + gaussians.position[2])
    assert torch.allclose(middle, before.position[2], atol=1e-6)
    gap = float((gaussians.position[1] - gaussians.position[2]).norm())
    assert gap == pytest.approx(float(before.log_scale[2].max().exp()), rel=1e-5)


def test_splitting_keeps_the_mass_and_nearly_the_shape():
    gaussians = cloud([1.0, 0.0])
    before = volume(gaussians)
    relocate(gaussians, torch.tensor([1.0, 0.0]), 1.0, all_of(gaussians))
    after = volume(gaussians)
    assert float(after.sum()) == pytest.approx(float(before.sum()), rel=0.01)
    # Two Gaussians 0.7 as long, a deviation apart, have 0.7^2 + 0.5^2 = 0.74 of the old variance.
    assert float((after - before).norm() / before.norm()) < 0.2


@pytest.mark.parametrize("attenuation, share", [([1.0, 2.0, 3.0], 1.0), ([1.0, 0.0, 0.0], 0.0)])
def test_nothing_moves_without_the_dead_or_without_leave(attenuation, share):
    gaussians = cloud(attenuation)
    before = gaussians.copy()
    assert len(relocate(gaussians, torch.ones(3), share, all_of(gaussians))) == 0
    assert all(
        torch.equal(a, b) for a, b in zip(gaussians.parameters().values(), before.parameters().values())
    )


def test_what_may_not_be_split_stays_and_nothing_moves_for_it():
    gaussians = cloud([1.0, 0.0, 2.0, 0.5, 0.0])
    before = gaussians.copy()
    changed = relocate(
        gaussians, torch.tensor([1.0, 0.0, 9.0, 0.2, 0.0]), 0.4, torch.tensor([1, 1, 0, 1, 1]).bool()
    )
    # The hardest two are the first and the third, and the fourth does not take the third's turn.
    assert sorted(changed.tolist()) == [0, 1]
    assert torch.equal(gaussians.position[2], before.position[2])


def test_no_more_move_than_are_worth_splitting():
    gaussians = cloud([1.0, 0.0, 0.0, 0.0])
    relocate(gaussians, torch.ones(4), 1.0, all_of(gaussians))
    assert bool(torch.isfinite(gaussians.position).all())
    assert int((gaussians.attenuation > 0).sum()) == 2
    assert math.isfinite(float(gaussians.attenuation.sum()))


def test_a_cloud_grows_by_halves_of_the_hardest_pulled():
    gaussians = cloud([1.0, 0.0, 2.0, 0.5], group=0)
    before, mass = gaussians.copy(), float(volume(gaussians).sum())
    grown, changed = grow(gaussians, torch.tensor([3.0, 9.0, 5.0, 0.2]), 2, 9.0)
    assert len(grown) == 6 and sorted(changed.tolist()) == [0, 2, 4, 5]
    for index in (1, 3):
        assert torch.equal(grown.position[index], before.position[index])
    # Halves follow in the order of the pull.
    for index, half in ((2, 4), (0, 5)):
        middle = 0.5 * (grown.position[index] + grown.position[half])
        assert torch.allclose(middle, before.position[index], atol=1e-6)
        assert grown.own_material[half] == before.own_material[index]
    assert float(volume(grown).sum()) == pytest.approx(mass, rel=0.01)


def test_no_more_are_split_than_hold_something():
    grown, changed = grow(cloud([1.0, 0.0, 0.0], group=0), torch.ones(3), 3, 9.0)
    assert len(grown) == 4 and sorted(changed.tolist()) == [0, 3]


def test_what_is_dense_is_not_split():
    gaussians = cloud([3.0, 3.0, 1.0, 1.0])
    gaussians.group = torch.tensor([0, -1, 1, -1])
    assert splittable(gaussians, 2.0).tolist() == [True, False, False, True]
    grown, changed = grow(gaussians, torch.tensor([1.0, 9.0, 8.0, 2.0]), 3, 2.0)
    assert len(grown) == 6 and sorted(changed.tolist()) == [0, 3, 4, 5]
