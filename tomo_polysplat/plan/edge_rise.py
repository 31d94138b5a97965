"""How sharp the edges of a start volume are: by which share of its height an edge rises from voxel to voxel."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from tomo_polysplat.evenly_spread import evenly_spread

__all__ = ["edge_rise"]

# Voxels on either side of an edge between which its height is taken.
_REACH = 3
# Lowest edge that is looked at, in soft references, and in deviations of the noise: lower ones are texture and streaks,
# and the steepest of their steps is steep by noise (the largest of five is 1.16 deviations above their mean, so by
# twenty times the noise a rise comes out 0.08 too large at most).
_LOWEST, _OVER_NOISE = 0.5, 20.0
# What is above this is matter, by whose second differences the noise is told.
_MATTER = 0.3
# Fewer edges do not tell. Planes that are looked at, evenly spread.
_FEWEST, _PLANES = 50, 24
_AT_ONCE = 1 << 18
# Edges that lie across the axes look less steep than they are: those of the steepest quarter lie along them.
_STEEPEST = 0.75


def edge_rise(relative: torch.Tensor) -> float:
    """Share of its height that an edge rises from one voxel to the next: the upper quartile of the edges in a volume.

    A step that is blurred by a Gaussian of deviation s voxels rises by ``erf(1 / (2 r)) / erf(5 / (2 r))`` with
    ``r = s sqrt(2)``: 0.60 for 0.6 voxels, 0.38 for one, 0.25 for two.

    Parameters
    ----------
    relative : (nz, ny, nx) tensor
        A volume in soft references.

    Returns
    -------
    float
        0 where there are too few edges.
    """
    planes = evenly_spread(len(relative), _PLANES)
    # Planes that are looked at together, as far as they are small.
    together = max(1, _AT_ONCE // max(relative[0].numel(), 1))
    groups = [planes[k : k + together].tolist() for k in range(0, len(planes), together)]
    # Noise would look like edges of its own: three planes and three lines together have a third of it.
    means = (
        torch.stack([relative[max(z - 1, 0) : z + 2].float().mean(dim=0) for z in group]) for group in groups
    )
    rises = [_rises(some.movedim(axis, 1)) for some in means for axis in (1, 2)]
    found: Any = torch.cat(rises).cpu().numpy()
    return float(np.quantile(found, _STEEPEST)) if len(found) >= _FEWEST else 0.0


def _rises(planes: torch.Tensor) -> torch.Tensor:
    """Of planes (planes, along, across): of each edge that is met along the second axis."""
    if planes.shape[1] < 2 * _REACH or planes.shape[2] < 3:
        return planes.new_zeros(0)
    lines = planes.unfold(2, 3, 1).mean(dim=3)
    around = lines.unfold(1, 2 * _REACH, 1)
    height = around.amax(dim=3) - around.amin(dim=3)
    steps = lines.diff(dim=1).abs().unfold(1, 2 * _REACH - 1, 1)
    middle = steps[..., _REACH - 1]
    least = [max(_LOWEST, _OVER_NOISE * _noise(plane)) for plane in lines]
    edges = (height > height.new_tensor(least)[:, None, None]) & (middle == steps.amax(dim=3))
    return middle[edges] / height[edges]


def _noise(lines: torch.Tensor) -> float:
    """Deviation of the noise along the first axis, by the median second difference of normal numbers."""
    bends = lines.diff(n=2, dim=0).abs()[lines[1:-1] > _MATTER]
    return float(bends.median()) / (0.6745 * math.sqrt(6)) if len(bends) else 0.0
