"""An order of Gaussians in which neighbours in the list are neighbours in space."""

from __future__ import annotations

import functools
import itertools
import operator

import torch

__all__ = ["spatial_order"]

_BITS = 10  # cells an axis: 1024
# Gaussians placed on the curve at once: on the way each takes some 30 numbers for each axis.
_AT_ONCE = 1 << 20


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
    parts = cells.split(_AT_ONCE)
    places = [_along_curve((part * (2**_BITS - 1)).nan_to_num(0.0).long()) for part in parts]
    return torch.argsort(torch.cat(places), stable=True)


def _along_curve(cell: torch.Tensor) -> torch.Tensor:
    """Where cells (n, axes) lie on the Hilbert curve, part of the cube in part of the cube.

    On each level a table tells which of its parts comes when, and how the curve lies in it.
    """
    axes = cell.shape[1]
    order, following = (torch.tensor(table, device=cell.device) for table in _parts(axes))
    levels = torch.arange(_BITS - 1, -1, -1, device=cell.device)[:, None]
    part = torch.zeros((_BITS, len(cell)), dtype=torch.int64, device=cell.device)
    for axis in cell.unbind(1):
        part = part << 1 | (axis >> levels & 1)
    place, way = torch.zeros_like(part[0]), torch.zeros_like(part[0])
    for each in part:
        entry = way << axes | each
        place, way = place << axes | order[entry], following[entry]
    return place


@functools.cache
def _parts(axes: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """For each way the curve can lie in a cube, and each of its parts: when that comes, and how the curve lies in it.

    By J. Skilling, AIP Conf. Proc. 707 (2004) 381: from the coarsest bit to the finest each part is turned and mirrored
    into the one that the curve passes first, the first axis taking the others' places. The Gray code of what is
    left counts the parts, backwards after an odd number of levels that end on the far side of the last axis.
    """
    first = (tuple(range(axes)), (0,) * axes, 0)
    ways, order, following = [first], [], []
    for taken, mirrored, turned in ways:  # which grows on the way
        for part in itertools.product((0, 1), repeat=axes):
            bits = [part[axis] ^ flip for axis, flip in zip(taken, mirrored)]
            inner, flips = list(taken), list(mirrored)
            for k, far in enumerate(bits):
                if far:
                    flips[0] ^= 1
                else:
                    inner[0], inner[k], flips[0], flips[k] = inner[k], inner[0], flips[k], flips[0]
            gray = list(itertools.accumulate(bits, operator.xor))
            way = (tuple(inner), tuple(flips), turned ^ gray[-1])
            if way not in ways:
                ways.append(way)
            order.append(sum((bit ^ turned) << (axes - 1 - k) for k, bit in enumerate(gray)))
            following.append(ways.index(way))
    return tuple(order), tuple(following)
