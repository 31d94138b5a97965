"""An order of Gaussians in which neighbours in the list are neighbours in space."""

from __future__ import annotations

import torch

__all__ = ["spatial_order"]

_BITS = 10  # cells an axis: 1024


def spatial_order(position: torch.Tensor) -> torch.Tensor:
    """Permutation (n,) int64 along a Hilbert curve through the bounding box of ``position`` (n, 3).

    The CUDA kernels look for Gaussians by groups of neighbours in the list, so a model kept in this order
    runs fast; sort it again whenever Gaussians are added or have moved far. Cells that follow each other on
    the curve share a face. On a Z-order curve some are far apart, and the window of a group that straddles
    such a leap is up to sixty times as large.
    """
    if not len(position):
        return torch.zeros(0, dtype=torch.int64, device=position.device)
    point = position.detach()
    extent = point.amax(0) - point.amin(0)
    cells = (point - point.amin(0)) / extent.amax().clamp_min(torch.finfo(point.dtype).tiny)
    # Of the curve through a cube little lies in one plane, and that with leaps: a plane has a curve of its own.
    cells = cells[:, extent > 0] if bool((extent > 0).any()) else cells
    return torch.argsort(_along_curve((cells * (2**_BITS - 1)).nan_to_num(0.0).long()), stable=True)


def _along_curve(cell: torch.Tensor) -> torch.Tensor:
    """Where cells (n, axes) lie on the Hilbert curve; by J. Skilling, AIP Conf. Proc. 707 (2004) 381.

    From the coarsest bit to the finest each part of the cube is turned and mirrored into the one that the
    curve passes first, the first axis taking the others' places. The Gray code of what is left counts the parts.
    """
    axes = list(cell.unbind(1))
    for bit in range(_BITS - 1, 0, -1):
        finer = (1 << bit) - 1
        for k in range(len(axes)):
            far = (axes[k] >> bit & 1).bool()
            exchanged = torch.where(far, 0, (axes[0] ^ axes[k]) & finer)
            axes[k] = axes[k] ^ exchanged
            axes[0] = axes[0] ^ torch.where(far, finer, exchanged if k else 0)
    for k in range(1, len(axes)):
        axes[k] = axes[k] ^ axes[k - 1]
    flips = torch.zeros_like(axes[0])
    for bit in range(_BITS - 1, 0, -1):
        flips ^= torch.where((axes[-1] >> bit & 1).bool(), (1 << bit) - 1, 0)
    place = torch.zeros_like(flips)
    for bit in range(_BITS - 1, -1, -1):
        for axis in axes:
            place = place << 1 | ((axis ^ flips) >> bit & 1)
    return place
