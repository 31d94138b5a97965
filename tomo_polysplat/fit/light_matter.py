"""The material number of soft matter that is lighter than the rest, where that is fat.

The start does not tell where it lies: its streaks and its cupping are as large as the difference. What is fitted after
one pass over the views does.
"""

from __future__ import annotations

import itertools

import torch

from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians

__all__ = ["light_gaussians", "tell_light"]

# In soft references: adipose tissue has 0.80 of the attenuation of water at 60 kV and 0.92 at 140.
_LIGHT = (0.65, 0.95)
# Share of the run after which every Gaussian stays what it was last told to be.
_UNTIL = 0.8


@torch.no_grad()
def tell_light(gaussians: Gaussians, scene: FitScene, share: float) -> None:
    """Give the Gaussians in light matter its number, and those no longer in it the soft one.

    Parameters
    ----------
    gaussians : Gaussians
        Changed in place.
    scene : FitScene
        With no ``light_u`` nothing is done.
    share : float
        Of the run that is done.
    """
    if not scene.light_u or scene.reference_curve is None or share > _UNTIL:
        return
    light, own = light_gaussians(gaussians, scene), gaussians.own_material
    soft = gaussians.shared_material[0]
    number = (soft + scene.light_u).clamp(min=scene.least_u)
    # A free number moves less in a run than the two are apart.
    told = (gaussians.group < 0) & ((own - number).abs() < 0.5 * (number - soft).abs())
    own.copy_(torch.where(light & ~told, number, torch.where(told & ~light, soft, own)))
    gaussians.group[light] = -1


@torch.no_grad()
def light_gaussians(gaussians: Gaussians, scene: FitScene) -> torch.Tensor:
    """(n,) which Gaussians outside metal lie in light matter.

    The median of the 27 voxels around it tells, which passes over noise and gives a layer of three voxels its own value
    up to its surface. At a rim to air the mean would be as light as fat.
    """
    median = _medians(scene.attenuation(gaussians, scene.box), scene.box.voxels_of(gaussians.position))
    return (median > _LIGHT[0]) & (median < _LIGHT[1]) & (gaussians.group <= 0)


def _medians(volume: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    """Median of the voxels (n, 3) and their neighbours; the faces of the volume go on beyond it."""
    last = torch.tensor(volume.shape, device=index.device) - 1
    around = [
        volume[tuple(torch.minimum((index + index.new_tensor(offset)).clamp(min=0), last).T)]
        for offset in itertools.product((-1, 0, 1), repeat=3)
    ]
    return torch.stack(around).median(dim=0).values
