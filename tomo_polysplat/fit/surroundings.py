"""Matter beside the volume, where neither volume nor detector holds all of the object.

Rays of a region of interest pass through what lies around it. Gaussians that may lie in the volume alone would have to
stand for that, too; so the volume that is fitted is larger, and what was asked for is cut out of it in the end.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np
import torch

from tomo_polysplat.fit.long_object import long_object
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.continued import few_rows, half_width
from tomo_polysplat.start.orbit import find_turns
from tomo_polysplat.start.weights import ray_offsets

__all__ = ["NO_MARGIN", "Margin", "Surroundings", "cut_out", "go_on", "surroundings_of"]

logger = logging.getLogger(__name__)

# Voxels more below, above, on either side in y, and in x.
Margin = tuple[int, int, int, int]
NO_MARGIN: Margin = (0, 0, 0, 0)


@dataclass(frozen=True)
class Surroundings:
    """The volume that is fitted for one that is asked for.

    Attributes
    ----------
    grid : VolumeGrid
    margin : tuple of int
        Voxels that it has more: below, above, on either side in y, and in x.
    why : str
        Words that say so; empty if it is the one that is asked for.
    missed : (views, rows) bool array
        Rows of the detector that see none of the volume, but matter above or below it.
    """

    grid: VolumeGrid
    margin: Margin
    why: str
    missed: np.ndarray


def surroundings_of(
    projections: np.ndarray, geometry: Geometry, grid: VolumeGrid, most: float, device: torch.device
) -> Surroundings:
    """The volume to be fitted: wider where the detector sees the object's sides nowhere, longer where it goes on.

    Parameters
    ----------
    projections : (views, rows, columns) array
        -log(I/I0); NaN for rays that are not to be used.
    geometry, grid : Geometry, VolumeGrid
    most : float
        Share of its edges that the volume is widened by at most at every side; 0: never.
    device : torch.device
        Where the width is asked: on the host of a GPU it took 3 ms or, until its threads had woken up, 80.
    """
    as_it_is = Surroundings(grid, NO_MARGIN, "", np.zeros((geometry.views, geometry.rows), bool))
    orbit = find_turns(geometry)[0] if most else None
    if orbit is None:
        return as_it_is
    few = torch.from_numpy(np.ascontiguousarray(few_rows(projections)))
    columns, radius, aside, words = half_width(few.to(device), geometry), 0.0, [0, 0], []
    if columns is not None:
        middle = 0.5 * (geometry.columns - 1)
        ends = (middle - columns, middle + columns)
        radius = float(np.abs(ray_offsets(geometry, orbit, ends)).mean())
        for k in (0, 1):
            beyond = max(grid.lower[k] - orbit.axis[k], orbit.axis[k] - grid.upper[k]) + radius
            aside[k] = _voxels(beyond, grid, k, most)
    if any(aside):
        words.append(
            f"{max(aside)} voxels more on every side: the object reaches beyond the detector and the volume,"
            f" {radius:.3g} from the axis if it is round"
        )
    long = long_object(projections, geometry, grid, orbit, radius)
    below = _voxels(grid.lower[2] - long.lower, grid, 2, most)
    above = _voxels(long.upper - grid.upper[2], grid, 2, most)
    if below or above:
        words.append(f"{below} slices more below and {above} above: the object is longer than the volume")
    if long.missed.any():
        words.append(f"{long.missed.mean():.0%} of the rays left out, which see it beside the volume alone")
    margin = (below, above, aside[1], aside[0])
    if not words:
        return as_it_is
    why = "fitted with " + "; ".join(words)
    logger.info("The volume is %s", why)
    return Surroundings(_grown(grid, margin), margin, why, long.missed)


def _voxels(beyond: float, grid: VolumeGrid, axis: int, most: float) -> int:
    """How many voxels a length beyond an end of the volume takes, up to a share of those along the axis."""
    # Half a voxel less is none: an object that fills the volume touches its sides.
    wanted = math.ceil(beyond / grid.voxel_size[axis] - 0.5)
    return min(max(wanted, 0), math.ceil(most * grid.shape[2 - axis]))


def _grown(grid: VolumeGrid, margin: Margin) -> VolumeGrid:
    """The grid with so many voxels more."""
    if not any(margin):
        return grid
    below, above, y, x = margin
    nz, ny, nx = grid.shape
    shape = nz + below + above, ny + 2 * y, nx + 2 * x
    lower, upper = (np.array([x, y, z]) * grid.voxel_size for z in (below, above))
    return VolumeGrid(shape, grid.lower - lower, grid.upper + upper)


def cut_out(volume: np.ndarray, margin: Margin) -> np.ndarray:
    """What was asked for of a volume (..., z, y, x), or (y, x), that has so many voxels more."""
    if not any(margin):
        return volume
    below, above, y, x = margin
    if below or above:
        volume = volume[..., below : volume.shape[-3] - above, :, :]
    return np.ascontiguousarray(volume[..., y : volume.shape[-2] - y, x : volume.shape[-1] - x])


def go_on(volume: torch.Tensor, margin: Margin) -> None:
    """Let slices (z, y, x) in the margin that are empty, as no ray tells of them, go on as the next ones, in place."""
    below, above, _, _ = margin
    slices = len(volume)
    outward = [(k, k + 1) for k in reversed(range(below))]
    outward += [(k, k - 1) for k in range(slices - above, slices)]
    for outer, inner in outward:
        if not bool(volume[outer].any()):
            volume[outer] = volume[inner]
