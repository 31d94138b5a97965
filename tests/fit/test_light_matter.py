"""Light matter is told by what is fitted: its Gaussians get its number, and give it back."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from small_clouds import blocks

from tomo_polysplat.fit.light_matter import light_gaussians, tell_light
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.plan.decisions.light import _light_mass

CURVE = torch.ones(3)
FAT = -0.056
SIZE = 7


class SharpScene(FitScene):
    """Every voxel holds what the Gaussian in it has for its attenuation, and air where there is none."""

    def attenuation(self, gaussians, box):
        volume = torch.zeros(box.shape)
        volume[tuple(box.voxels_of(gaussians.position).T)] = gaussians.attenuation
        return volume


def of_levels(levels):
    """A scene of blocks of these levels, the last one of metal, the block of each Gaussian, and its place in that."""
    gaussians, box = blocks(levels, SIZE)
    block = gaussians.group.clone()
    gaussians.attenuation = torch.tensor(levels)[block]
    gaussians.group = torch.where(block == len(levels) - 1, 1, 0)
    gaussians.shared_material = torch.tensor([0.0, 0.8])
    fixed = ("reference", 3.0, 0.1, False, (0.1, 0.1), False, 1, 0.2)
    wide = replace(box, first=box.first - 1, shape=tuple(n + 2 for n in box.shape))
    scene = SharpScene(wide, None, 1.0, CURVE, CURVE, -0.1, *fixed, light_u=FAT)
    place = gaussians.position - torch.tensor([0.0, 0.0, 2.0 * SIZE]) * block[:, None]
    return gaussians, scene, block, place


def test_light_matter_is_light_up_to_its_faces_and_no_rim_of_other_matter_is():
    gaussians, scene, block, place = of_levels([1.0, 0.8, 0.5, 20.0])
    light = light_gaussians(gaussians, scene)
    faces = ((place == 0) | (place == SIZE - 1)).sum(dim=1)
    assert light[(block == 1) & (faces <= 1)].all()
    assert not light[(block == 1) & (faces > 1)].any() and not light[block != 1].any()


def test_the_mass_that_is_light_is_a_share_of_what_is_not_metal():
    """Of a light block all but its edges, which lie beside too much air."""
    gaussians, scene, *_ = of_levels([1.0, 0.8, 20.0])
    light_ones = SIZE**3 - 12 * SIZE + 16
    share = _light_mass(SimpleNamespace(gaussians=gaussians, scene=scene))
    assert share == pytest.approx(0.8 * light_ones / (1.8 * SIZE**3), rel=1e-5)


def test_one_noisy_voxel_makes_nothing_light():
    gaussians, scene, _, place = of_levels([1.0, 20.0])
    gaussians.attenuation[(place == 3).all(dim=1)] = 0.8
    assert not light_gaussians(gaussians, scene).any()


def test_a_gaussian_gets_the_number_and_gives_it_back_when_its_place_is_light_no_longer():
    gaussians, scene, block, _ = of_levels([1.0, 0.8, 20.0])
    light = light_gaussians(gaussians, scene)
    tell_light(gaussians, scene, 0.1)
    assert (gaussians.own_material[light] == np.float32(FAT)).all() and (gaussians.group[light] == -1).all()
    assert torch.equal(gaussians.group[~light], (block == 2)[~light].long())
    gaussians.own_material[light] += 0.01
    gaussians.attenuation[block == 1] = 1.0
    tell_light(gaussians, scene, 0.2)
    assert (gaussians.own_material[light] == 0).all()


@pytest.mark.parametrize("soft", [0.0, -0.08, 0.1])
def test_a_number_of_its_own_that_is_not_fats_stays(soft):
    """Wherever soft matter has come to."""
    gaussians, scene, block, _ = of_levels([1.0, 0.8, 20.0])
    gaussians.shared_material[0] = soft
    gaussians.group[block == 0], gaussians.own_material[block == 0] = -1, 0.3
    tell_light(gaussians, scene, 0.1)
    assert (gaussians.own_material[block == 0] == np.float32(0.3)).all()


@pytest.mark.parametrize(
    "changes, share", [({"light_u": 0.0}, 0.1), ({}, 0.9), ({"reference_curve": None}, 0.1)]
)
def test_nothing_is_told_where_it_is_soft_matter_late_and_of_one_curve(changes, share):
    gaussians, scene, *_ = of_levels([1.0, 0.8, 20.0])
    before = gaussians.copy()
    tell_light(gaussians, replace(scene, **changes), share)
    assert torch.equal(gaussians.own_material, before.own_material)
    assert torch.equal(gaussians.group, before.group)
