"""How much light an object takes away: closed forms of balls and discs, and the weight that follows."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.plan.depth import optical_depth, weights_by_depth
from tomo_polysplat.scan.geometry import VolumeGrid


class Unit:
    """What `optical_depth` reads of a problem: lengths in the caller's unit, one energy."""

    def __init__(self, grid, length):
        self.grid, self.length = grid, length

    def soft_attenuation(self):
        return 1.0


def body(shape, radius, value):
    """A ball, or a disc where there is one slice, in a window of edge 2; the longest axis has cubic voxels."""
    axes = [(np.arange(n) + 0.5) / n * 2 - 1 for n in shape]
    if shape[0] == 1:
        axes[0] = np.zeros(1)
    z, y, x = np.meshgrid(*axes, indexing="ij")
    return torch.from_numpy(value * (x**2 + y**2 + z**2 < radius**2))


@pytest.mark.parametrize(
    ("shape", "mean_chord"),
    [((1, 151, 149), 16 / (3 * math.pi)), ((51, 47, 49), 1.5)],
    ids=["disc", "ball"],
)
def test_a_disc_and_a_ball_have_the_mean_chord_weighed_by_length(shape, mean_chord):
    grid = VolumeGrid(shape, lower=np.full(3, -1.0), upper=np.full(3, 1.0))
    depth = optical_depth(body(shape, 0.7, 1.0), 0.1, reference=0.4, problem=Unit(grid, length=3.0))
    assert depth == pytest.approx(mean_chord * 0.7 * 0.4 * 3.0, rel=0.03)


def test_metal_counts_as_soft_matter_and_noise_as_nothing():
    grid = VolumeGrid((1, 101, 101), lower=np.full(3, -1.0), upper=np.full(3, 1.0))
    soft = body((1, 101, 101), 0.7, 1.0)
    some = torch.where(body((1, 101, 101), 0.2, 1.0) > 0, 30.0, soft)
    some = torch.where(some == 0, torch.full_like(some, 0.2), some)
    depths = [optical_depth(volume, 0.1, 1.0, Unit(grid, 1.0)) for volume in (soft, some)]
    assert depths[0] == depths[1] > 0
    assert optical_depth(torch.zeros(1, 101, 101), 0.1, 1.0, Unit(grid, 1.0)) == 0.0


def rays_of(photons):
    views = DetectorViews.__new__(DetectorViews)
    return Rays(torch.zeros(1, 1, 1), views, photons, model_error=0.015, held_out=0.01)


def test_the_weight_goes_with_the_depth_and_with_the_noise():
    rays = rays_of(1e4)
    assert weights_by_depth(0.0, rays) == weights_by_depth(2.0, rays) == (1.0, 1.0)
    share, both = weights_by_depth(0.09, rays)
    noise, error = 1e-2, 0.015
    assert share == pytest.approx(0.1)
    assert both == pytest.approx(0.1 * math.hypot(noise, 0.1 * error) / math.hypot(noise, error))
    # Without noise a tenth of the depth is a tenth of everything that the model gets wrong.
    assert weights_by_depth(0.09, replace(rays, photons=math.inf))[1] == pytest.approx(0.01)
