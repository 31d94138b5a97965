"""Which voxels of a volume have no edge beside them, compiled for the CPU: what torch finds, to the bit.

Extremes of a box are those of its rows, then of its columns, then of its depth.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from tomo_polysplat.compiled import njit
from tomo_polysplat.kernels.numba_lanes import LANES, larger, load, smaller, store
from tomo_polysplat.kernels.step.faint import BESIDE, EDGE

__all__ = ["away_from_edges"]


def away_from_edges(volume: torch.Tensor, corner: float, dense: float) -> torch.Tensor:
    """``fit.loss.away_from_edges`` of a volume (nz, ny, nx) of float32, so shaped."""
    shape = volume.shape
    most, least = (_continued(volume.detach()) for _ in range(2))
    apart = 1
    for width in most.shape[::-1]:
        _extremes(most, least, apart)
        apart *= width
    most, least = (part[: shape[0], : shape[1], : shape[2]] for part in (most, least))
    near = most - least < np.float32(EDGE * corner)
    near &= most <= np.float32(dense)
    return torch.from_numpy(near)


def _continued(volume: torch.Tensor) -> np.ndarray:
    """The volume, continued by its faces: another voxel that is as the last one changes no extreme."""
    inside = tuple(slice(BESIDE, BESIDE + length) for length in volume.shape)
    lengths = [length + 2 * BESIDE for length in volume.shape]
    # The last lanes reach beyond the end.
    wider = volume.new_empty(math.prod(lengths) + LANES)[:-LANES].view(lengths).numpy()
    wider[inside] = volume.numpy()
    for axis, length in enumerate(volume.shape):
        along = np.moveaxis(wider, axis, 0)
        along[:BESIDE], along[BESIDE + length :] = along[BESIDE], along[BESIDE + length - 1]
    return wider


@njit(nogil=True, cache=True, error_model="numpy")
def _extremes(most, least, apart):
    """Make each number the largest, or the least, of it and of those up to twice ``BESIDE`` behind it, ``apart`` from
    each other, in place; not of the last ones, behind which there are fewer."""
    end = most.size - 2 * BESIDE * apart
    for begin in range(0, end, LANES):
        at = begin
        high, low = load(most, at), load(least, at)
        for _ in range(2 * BESIDE):
            at += apart
            high, low = larger(high, load(most, at)), smaller(low, load(least, at))
        store(most, begin, high)
        store(least, begin, low)
