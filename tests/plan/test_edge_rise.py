"""How sharp edges are, of steps and blobs in closed form."""

import math
import sys

import pytest
import torch

from tomo_polysplat.plan.edge_rise import edge_rise


def step(deviation, tilt=0.0):
    """(12, 24, 24) a step in x that is blurred by so many voxels, over a slope in y."""
    x = torch.arange(24, dtype=torch.float64) - 11.5
    rise = 0.5 * (1 + torch.erf(x / (deviation * math.sqrt(2))))
    return rise.expand(12, 24, 24).clone() + tilt * torch.arange(24)[None, :, None]


@pytest.mark.parametrize("deviation", [0.6, 1.0, 2.0])
def test_a_blurred_step_rises_as_the_closed_form_says(deviation):
    root = 2 * deviation * math.sqrt(2)
    expected = math.erf(1 / root) / math.erf(5 / root)
    assert edge_rise(step(deviation)) == pytest.approx(expected, abs=1e-4)


def test_low_steps_and_few_do_not_tell():
    assert edge_rise(0.4 * step(0.6)) == 0.0
    assert edge_rise(step(0.6)[:1, :10]) == 0.0
    assert edge_rise(torch.zeros(1, 4, 2)) == 0.0


def test_noise_does_not_make_a_smooth_object_look_sharp():
    z, y, x = torch.meshgrid(
        *[torch.arange(n, dtype=torch.float64) - n / 2 for n in (9, 40, 40)], indexing="ij"
    )
    blob = 2 * torch.exp(-(x**2 + y**2) / (2 * 4.0**2))
    noise = torch.randn(blob.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for deviation in (0.0, 0.1, 0.3, 1.0):
        assert edge_rise(blob + deviation * noise) < 1 / 3


def test_planes_tell_the_same_one_by_one(monkeypatch):
    """Of each its own noise decides what is an edge."""
    volume = 2 * step(0.6).float()
    noise = torch.randn(volume.shape, generator=torch.Generator().manual_seed(0))
    volume += 0.03 * torch.arange(len(volume))[:, None, None] * noise
    together = edge_rise(volume)
    monkeypatch.setattr(sys.modules[edge_rise.__module__], "_AT_ONCE", 1)
    assert edge_rise(volume) == together > 0
