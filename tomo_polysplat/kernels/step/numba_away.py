"""Which voxels of a volume have no edge beside them, compiled for the CPU: what torch finds, to the bit.

Extremes of a box are those of its rows, then of its columns, then of its depth. Planes are taken one by one, and the
last few kept.
"""

from __future__ import annotations

import numpy as np
import torch

from tomo_polysplat.compiled import njit
from tomo_polysplat.kernels.numba_lanes import LANES, larger, load, smaller, store
from tomo_polysplat.kernels.step.faint import BESIDE, EDGE

__all__ = ["away_from_edges"]

# Planes that hold all that is beside one of them.
_KEPT = 2 * BESIDE + 1


def away_from_edges(volume: torch.Tensor, corner: float, dense: float) -> torch.Tensor:
    """``fit.loss.away_from_edges`` of a volume (nz, ny, nx) of float32, so shaped."""
    near = torch.empty(volume.shape, dtype=torch.bool)
    _, ny, nx = volume.shape
    # The first row is continued on either side, by its first and its last voxel.
    padded = np.empty((1 + 2 * (1 + _KEPT), ny, -(-(nx + 2 * BESIDE) // LANES) * LANES + LANES), np.float32)
    _away(volume.contiguous().numpy(), np.float32(EDGE * corner), np.float32(dense), padded, near.numpy())
    return near


@njit(nogil=True, cache=True, error_model="numpy")
def _away(volume, edge, dense, planes, near):
    """Planes of ``planes``: one that is padded, two on the way, and then the extremes of the last ``_KEPT`` planes."""
    nz, ny, nx = volume.shape
    stride = planes.shape[2]
    plane = ny * stride
    for z in range(nz + BESIDE):
        if z < nz:
            for y in range(ny):
                for x in range(stride):
                    planes[0, y, x] = volume[z, y, min(max(x - BESIDE, 0), nx - 1)]
                for j in range(0, stride - LANES, LANES):
                    at = y * stride + j
                    most = least = load(planes, at)
                    for k in range(at + 1, at + _KEPT):
                        value = load(planes, k)
                        most, least = larger(most, value), smaller(least, value)
                    store(planes, plane + at, most)
                    store(planes, 2 * plane + at, least)
            to = (3 + 2 * (z % _KEPT)) * plane
            for y in range(ny):
                first, last = max(y - BESIDE, 0), min(y + BESIDE, ny - 1)
                for j in range(0, stride - LANES, LANES):
                    at = plane + first * stride + j
                    most, least = load(planes, at), load(planes, at + plane)
                    for _ in range(first, last):
                        at += stride
                        most, least = larger(most, load(planes, at)), smaller(least, load(planes, at + plane))
                    store(planes, to + y * stride + j, most)
                    store(planes, to + plane + y * stride + j, least)
        middle = z - BESIDE
        if middle >= 0:
            for y in range(ny):
                for j in range(0, stride - LANES, LANES):
                    start = 3 * plane + y * stride + j
                    at = start + 2 * (middle % _KEPT) * plane
                    most, least = load(planes, at), load(planes, at + plane)
                    for k in range(max(middle - BESIDE, 0), min(z, nz - 1) + 1):
                        at = start + 2 * (k % _KEPT) * plane
                        most, least = larger(most, load(planes, at)), smaller(least, load(planes, at + plane))
                    store(planes, plane + y * stride + j, most)
                    store(planes, 2 * plane + y * stride + j, least)
                most_of, least_of = planes[1, y], planes[2, y]
                for x in range(nx):
                    near[middle, y, x] = (most_of[x] - least_of[x] < edge) and most_of[x] <= dense
