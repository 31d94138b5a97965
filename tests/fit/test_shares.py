"""Which Gaussians each of several ranks holds, and that the planes they have in common make the whole volume."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from tomo_polysplat.fit.shares import Part, fit_in, parted, planes_of_all, reached
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.ranks import Ranks
from tomo_polysplat.render.renderer import voxelise_gaussians

sys.path.append(str(Path(__file__).parents[1] / "kernels"))
from step_scenes import fit_problem

CPU = torch.device("cpu")
BOX = VoxelBox(np.array([-0.9, -0.9, -0.98]), np.array([0.2, 0.2, 0.04]), (50, 10, 10))


def cloud(count=60, deviation=0.03):
    """Gaussians of several sizes all over the box."""
    generator = torch.Generator().manual_seed(5)
    position = 1.8 * torch.rand((count, 3), generator=generator) - 0.9
    scale = deviation * (0.5 + torch.rand((count, 3), generator=generator))
    ones = torch.ones(count)
    turned = torch.rand((count, 4), generator=generator) - 0.5
    common = torch.zeros(1), torch.zeros(count, dtype=torch.int64), torch.zeros(1)
    return Gaussians(position, scale.log(), turned, ones, 0 * ones, *common)


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_each_gaussian_is_in_one_part_and_parts_are_slabs(count):
    gaussians = cloud()
    parts = parted(gaussians, count)
    assert sorted(torch.cat(parts).tolist()) == list(range(len(gaussians)))
    assert {len(part) for part in parts} <= {60 // count, -(-60 // count)}
    z = gaussians.position[:, 2]
    assert all(z[low].max() <= z[high].min() for low, high in zip(parts, parts[1:]))
    assert all(bool((part.diff() > 0).all()) for part in parts), "neighbours in space stay so in the list"


def test_gaussians_of_one_plane_are_parted_as_well():
    gaussians = fit_problem("fan", True, "cpu", "numba").gaussians
    parts = parted(gaussians, 3)
    assert [len(part) for part in parts] == [5, 6, 6]
    assert reached(gaussians, parts, VoxelBox(np.zeros(3), np.ones(3), (1, 7, 9))) == [slice(0, 1)] * 3


@pytest.mark.parametrize(("count", "deviation"), [(2, 0.03), (3, 0.03), (4, 0.1), (3, 0.3)])
def test_the_planes_of_all_make_the_whole_volume(count, deviation):
    """With slabs wide and narrow beside what Gaussians reach."""
    gaussians = cloud(deviation=deviation)
    whole = voxelise_gaussians(gaussians, gaussians.weights(None), BOX, "numba")[0]
    parts = parted(gaussians, count)
    held = planes_of_all(gaussians, parts, BOX)
    ranks = [Part(Ranks(k, count), planes, CPU) for k, planes in enumerate(held)]
    made = []
    for part, index in zip(ranks, parts):
        own = gaussians.select(index)
        made.append(voxelise_gaussians(own, own.weights(None), part.box(BOX), "numba")[0])
    lent = sum(part.lent(volume) for part, volume in zip(ranks, made))
    for part, volume in zip(ranks, made):
        part.take(lent, volume)
        torch.testing.assert_close(volume, whole[part.planes], rtol=1e-5, atol=1e-6)
    assert {plane for part in ranks for plane in range(50)[part.planes]} == set(range(50))
    assert len(lent) < 50 or deviation > 0.03


def test_who_has_wandered_or_grown_beyond_its_planes_is_told():
    gaussians = cloud()
    parts = parted(gaussians, 2)
    held = planes_of_all(gaussians, parts, BOX)
    assert fit_in(gaussians, parts, BOX, held)
    lowest = int(gaussians.position[:, 2].argmin())
    for change in (
        lambda far: far.position[lowest, 2].mul_(-1),
        lambda far: far.log_scale[lowest].fill_(0.0),
    ):
        far = gaussians.copy()
        change(far)
        assert not fit_in(far, parts, BOX, held)
        assert fit_in(far, parted(far, 2), BOX, planes_of_all(far, parted(far, 2), BOX))
    within = gaussians.copy()
    within.position[:, 2] += 0.04
    within.log_scale += 0.1
    assert fit_in(within, parts, BOX, held)
