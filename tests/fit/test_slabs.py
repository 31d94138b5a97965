"""A volume that is made by slabs is that made in one piece."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.model import seed_samples
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.start import levels
from tomo_polysplat.start.slabs import slabs

SHAPE = (17, 13, 15)


def scene():
    spacing = np.full(3, 1 / 15)
    box = VoxelBox(-0.5 + 0.5 * spacing, spacing, SHAPE)
    curves = torch.tensor([1.0, 2.5, 9.0])
    return FitScene(box, None, 1.0, curves, curves, 0.0, "numba", 0.5, False, (0.0, 0.0), False, 1, 0.2)


def cloud(metal):
    """Thin and wide Gaussians, some of them a piece of metal."""
    rng = np.random.default_rng(3)
    position = torch.as_tensor(rng.uniform(-0.4, 0.4, (60, 3)), dtype=torch.float32)
    scale = torch.as_tensor(np.log(rng.uniform(0.01, 0.1, (60, 3))), dtype=torch.float32)
    rotation = torch.as_tensor(rng.standard_normal((60, 4)), dtype=torch.float32)
    group = torch.zeros(60, dtype=torch.int64)
    if metal:
        group[:20] = 1
        position[:20, :2] *= 0.2
    height = torch.where(group > 0, 6.0, 1.0)
    return Gaussians(
        position, scale, rotation, height, torch.zeros(60), torch.tensor([0.0, 0.8]), group, torch.zeros(1)
    )


@pytest.mark.parametrize("metal", [False, True])
@pytest.mark.parametrize("slices", [1, 3, 17])
def test_slabs_of_any_size_make_the_same_volume(slices, metal):
    made, gaussians = scene(), cloud(metal)
    whole = made.basis(gaussians).numpy() * 0.3
    bare = replace(made, metal_tail=0.0).basis(gaussians).numpy() * 0.3
    assert metal == bool(np.abs(whole - bare).max() > 0.01 * whole.max()), (
        "tails are moved where there is metal"
    )
    found = made.basis_on_host(gaussians, 0.3, slices * SHAPE[1] * SHAPE[2])
    np.testing.assert_allclose(found, whole, rtol=1e-4, atol=1e-5 * whole.max())
    seen = made.volume_on_host(gaussians, 2.0, slices * SHAPE[1] * SHAPE[2])
    expected = 2 * made.volume(gaussians).numpy()
    np.testing.assert_allclose(seen, expected, rtol=1e-4, atol=1e-5 * expected.max())


def test_every_slice_is_in_one_slab():
    for depth in (1, 4, 30):
        parts = list(slabs(17, depth, 2))
        assert np.concatenate([np.arange(17)[wanted] for wanted, _, _ in parts]).tolist() == list(range(17))
        for wanted, first, last in parts:
            assert first == max(wanted.start - 2, 0) and last == min(wanted.stop + 2, 17)


@pytest.mark.parametrize("slices", [1, 3])
def test_windows_do_not_see_slabs(monkeypatch, slices):
    volume = torch.randn(SHAPE, generator=torch.Generator().manual_seed(0))
    cells, reach = np.array([4, 3, 2]), [2, 0, 1]
    mean, largest = seed_samples.box_mean(volume, cells), seed_samples.largest_around(volume, reach)
    monkeypatch.setattr(seed_samples, "_AT_ONCE", slices * SHAPE[1] * SHAPE[2])
    assert torch.equal(seed_samples.box_mean(volume, cells), mean)
    assert torch.equal(seed_samples.largest_around(volume, reach), largest)
    inner = volume[3 - 2 : 3 + 2, 5 - 1 : 5 + 2, 7 - 1 : 7 + 1]
    assert float(mean[3, 5, 7]) == pytest.approx(float(inner.mean()), abs=1e-6)
    assert float(largest[8, 5, 7]) == float(volume[6:11, 5, 6:9].max())


def test_the_level_of_half_the_mass_is_that_of_sorted_values_whatever_is_looked_at_at_once(monkeypatch):
    values = torch.randn(SHAPE, generator=torch.Generator().manual_seed(1)).exp() - 0.5
    ordered = values[values > 0].double().sort().values
    mass = ordered.cumsum(0)
    monkeypatch.setattr(levels, "_AT_ONCE", 100)
    for share in (0.1, 0.5, 0.7):
        assert levels.mass_level(values, share) == float(ordered[torch.searchsorted(mass, share * mass[-1])])
