"""Which Gaussians may become two: those that can show something finer than they do."""

from __future__ import annotations

import functools
import itertools
import math

import torch

from tomo_polysplat.fit.metal_voxels import levels_of_pieces, metal_voxels
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.density_control import HALF
from tomo_polysplat.model.gaussians import Gaussians

__all__ = ["may_be_finer"]

# A voxel that holds less than this share of a piece of metal is at its edge.
_EDGE = 0.5


@torch.no_grad()
def may_be_finer(gaussians: Gaussians, scene: FitScene, smallest: float) -> torch.Tensor:
    """(n,) bool: which Gaussians may be split.

    Rays pull at dense matter more than at any other, also by their noise alone. Two kinds of splits are no use:

    - of what is as small as a Gaussian may be: its halves would not be smaller, and hold more than it did;
    - inside a piece of metal, where all is the same. Halves only add noise to it (docs/decisions/relocation.md).

    Parameters
    ----------
    gaussians : Gaussians
    scene : FitScene
    smallest : float
        Logarithm of the smallest deviation that a Gaussian may have.
    """
    may = gaussians.log_scale.amax(dim=1) + math.log(HALF) >= smallest
    members = (gaussians.group > 0).nonzero()[:, 0]
    if len(members):
        metal = gaussians.select(members)
        values, index = metal_voxels(metal, scene)
        _, levels, of_each = levels_of_pieces(metal, values, index)
        may[members] &= _least_around(values, index) < _EDGE * levels[of_each]
    return may


def _least_around(values: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    """(n,) least value of the voxels at (n, 3) indices and of all that touch them; a volume goes on at its faces."""
    last = index.new_tensor(values.shape) - 1
    beside = (
        torch.minimum((index + index.new_tensor(step)).clamp(min=0), last)
        for step in itertools.product((-1, 0, 1), repeat=3)
    )
    return functools.reduce(torch.minimum, (values[tuple(at.T)] for at in beside))
