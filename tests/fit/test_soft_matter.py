"""The soft matter's number follows the cupping of homogeneous objects, and of no others."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tomo_polysplat.fit.soft_matter import cupping, flatten
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings

LEVELS = Settings().bone_level, Settings().metal_level


def cylinder(*, slope=0.0, noise=0.0, radius=12.0, size=31):
    """A cylinder whose attenuation grows with the distance from its surface, by ``slope`` in all."""
    z, y, x = np.mgrid[:9, :size, :size] - np.array([4, size // 2, size // 2])[:, None, None, None]
    depth = np.clip(radius - np.hypot(x, y), 0.0, None)
    volume = np.where(depth > 0, 1.1 * (1 + slope * depth / radius), 0.0)
    return volume + noise * np.random.default_rng(0).normal(size=volume.shape)


@pytest.mark.parametrize("slope", [-0.04, 0.0, 0.03])
def test_cupping_is_found_behind_noise_and_beside_metal(slope):
    volume = cylinder(slope=slope, noise=0.02)
    volume[:, 10:12, 10:12] = 40.0
    # Layers span most of the depth: their slope is that of the whole.
    found, error = cupping(volume, *LEVELS)
    assert found == pytest.approx(slope, abs=0.006) and error < 0.004


def test_of_several_matters_nothing_is_said():
    half = cylinder()
    half[:, :, 15:] *= 1.3
    bone = cylinder()
    bone[:, 13:17, 13:17] = 3.0
    assert cupping(half, *LEVELS) is None and cupping(bone, *LEVELS) is None


def test_a_part_of_aluminium_is_not_soft():
    assert cupping(7.0 / 1.1 * cylinder(slope=0.03), LEVELS[0], 20.0) is None


def test_an_object_that_fills_the_window_has_no_depth():
    ramp = 1 + 0.06 * np.broadcast_to(np.linspace(0, 1, 21), (21, 21, 21))
    assert cupping(ramp, *LEVELS) is None


def test_oblong_voxels_do_not_change_where_the_inside_is():
    volume = cylinder(slope=0.03)
    squeezed = volume[:, ::2]
    assert cupping(squeezed, *LEVELS, np.array([0.5, 1.0, 0.5]))[0] == pytest.approx(0.03, abs=0.006)


def test_thin_or_empty_objects_say_nothing():
    assert cupping(cylinder(radius=2.0), *LEVELS) is None
    assert cupping(np.zeros((9, 9, 9)), *LEVELS) is None


def test_a_slice_is_judged_as_a_volume_is():
    volume = cylinder(slope=0.03, radius=30.0, size=71)
    assert cupping(volume[4:5], *LEVELS)[0] == pytest.approx(0.03, abs=0.006)


def few_gaussians():
    return Gaussians(
        torch.zeros(4, 3), torch.zeros(4, 3), torch.ones(4, 4), torch.ones(4),
        torch.tensor([0.0, 0.05, 0.5, 0.8]), torch.tensor([0.0, 0.8]), torch.tensor([0, -1, -1, 1]), torch.zeros(1),
    )  # fmt: skip


def scene_of(volume):
    box = VoxelBox(np.zeros(3), np.ones(3), volume.shape)
    return SimpleNamespace(
        reference_curve=torch.ones(3),
        box=box,
        least_u=-0.1,
        attenuation=lambda gaussians, box: torch.from_numpy(volume),
    )


def test_what_is_too_dense_inside_lowers_the_number_of_soft_matter_alone():
    gaussians, settings = few_gaussians(), Settings()
    flatten(gaussians, scene_of(cylinder(slope=0.04)), settings, 0.5)
    change = float(gaussians.shared_material[0])
    assert change == pytest.approx(-0.02 * settings.soft_gain, abs=0.002)
    assert gaussians.shared_material[1] == pytest.approx(0.8)
    assert gaussians.own_material.numpy() == pytest.approx([change, 0.05 + change, 0.5, 0.8], abs=1e-6)


def dark_core():
    """A flat cylinder whose deepest layer alone is darker."""
    volume = cylinder()
    z, y, x = np.mgrid[:9, :31, :31] - np.array([4, 15, 15])[:, None, None, None]
    volume[np.hypot(x, y) < 4] *= 0.98
    return volume


def test_one_layer_does_not_make_the_number_leave_but_brings_it_back():
    settings = Settings()
    gaussians, away = few_gaussians(), few_gaussians()
    away.shared_material[0] = -0.05
    flatten(gaussians, scene_of(dark_core()), settings, 0.5)
    flatten(away, scene_of(dark_core()), settings, 0.5)
    assert float(gaussians.shared_material[0]) == 0.0 and float(away.shared_material[0]) > -0.05


def test_a_rim_of_fat_does_not_make_the_number_leave():
    z, y, x = np.mgrid[:9, :41, :41] - np.array([4, 20, 20])[:, None, None, None]
    radius = np.hypot(x, y)
    # Between fat and tissue voxels hold some of both.
    torso = np.where(radius < 18, 0.9 + 0.12 * np.clip((16 - radius) / 2, 0, 1), 0.0)
    gaussians = few_gaussians()
    flatten(gaussians, scene_of(torso), Settings(), 0.5)
    assert float(gaussians.shared_material[0]) == 0.0


def test_without_evidence_the_number_goes_back_towards_where_it_began():
    gaussians, settings = few_gaussians(), Settings(soft_u=0.02)
    gaussians.shared_material[0] = -0.05
    flatten(gaussians, scene_of(np.zeros((9, 9, 9))), settings, 0.5)
    assert float(gaussians.shared_material[0]) == pytest.approx(-0.05 + 0.5 * 0.07)


@pytest.mark.parametrize("changes, share", [({"soft_gain": 0.0}, 0.5), ({}, 0.1), ({}, 0.9)])
def test_it_is_held_when_asked_for_and_at_both_ends_of_a_run(changes, share):
    gaussians = few_gaussians()
    flatten(gaussians, scene_of(cylinder(slope=0.04)), Settings(**changes), share)
    assert float(gaussians.shared_material[0]) == 0.0
