"""Values of a start volume at seeds."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from tomo_polysplat.scan.geometry import VolumeGrid

__all__ = ["box_mean", "largest_around", "reaches", "voxel_of", "widened"]

# Voxels of a slab for which windows are looked at together: only of so many there is a copy with margins.
_AT_ONCE = 1 << 25


def box_mean(volume: torch.Tensor, cells: np.ndarray) -> torch.Tensor:
    """Mean over (z, y, x) voxels around each one; beyond the volume its outermost values go on."""
    if cells.max() == 1:
        return volume
    ends = [(n // 2, n - 1 - n // 2) for n in cells.tolist()]
    return _by_slabs(
        volume, ends, lambda some: torch.nn.functional.avg_pool3d(some, cells.tolist(), stride=1)
    )


def largest_around(volume: torch.Tensor, reach: Sequence[int]) -> torch.Tensor:
    """The largest value within ``reach`` (z, y, x) voxels along each axis."""

    def largest(some: torch.Tensor) -> torch.Tensor:
        for axis, n in enumerate(reach):
            window = [1, 1, 1]
            window[axis] = 2 * n + 1
            some = torch.nn.functional.max_pool3d(some, window, stride=1)
        return some

    return _by_slabs(volume, [(n, n) for n in reach], largest)


def _by_slabs(
    volume: torch.Tensor, ends: Sequence[tuple[int, int]], pool: Callable[[torch.Tensor], torch.Tensor]
) -> torch.Tensor:
    """What a pool makes of a volume with so many voxels more at both ends of each axis, which repeat the outermost."""
    nz, (before, after), found = len(volume), ends[0], torch.empty_like(volume)
    margins = [end for pair in ends[:0:-1] for end in pair] + [0, 0]
    depth = max(1, _AT_ONCE // max(volume[0].numel(), 1))
    for z in range(0, nz, depth):
        last = min(z + depth, nz)
        slices = torch.arange(z - before, last + after, device=volume.device).clamp(0, nz - 1)
        padded = torch.nn.functional.pad(volume[slices][None, None], margins, mode="replicate")
        found[z:last] = pool(padded)[0, 0]
    return found


def voxel_of(points: torch.Tensor, grid: VolumeGrid) -> tuple[torch.Tensor, ...]:
    """Indices (z, y, x) of the voxels that hold points (n, 3), or of the nearest ones."""
    lower, size = (torch.from_numpy(np.array(v)).to(points.device) for v in (grid.lower, grid.voxel_size))
    index = ((points - lower) / size).long()
    return tuple(index[:, 2 - k].clamp(0, grid.shape[k] - 1) for k in range(3))


def reaches(
    start: torch.Tensor, points: torch.Tensor, grid: VolumeGrid, level: float, reach: float
) -> torch.Tensor:
    """Which points have a voxel above a level within a distance along every axis."""
    near = start > level
    if not bool(near.any()):
        return torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for axis, size in enumerate(grid.voxel_size[::-1]):
        # A whole number of voxels must not lose one to rounding.
        near = _grown(near, axis, int(reach / size + 1e-6))
    return near[voxel_of(points, grid)]


def _grown(mask: torch.Tensor, axis: int, voxels: int) -> torch.Tensor:
    """A mask widened by ``voxels`` both ways along an axis; every step nearly trebles the width."""
    length, half = mask.shape[axis], 0
    while half < min(voxels, length - 1):
        step = min(2 * half + 1, voxels - half, length - 1)
        wider = mask.clone()
        wider.narrow(axis, step, length - step).logical_or_(mask.narrow(axis, 0, length - step))
        wider.narrow(axis, 0, length - step).logical_or_(mask.narrow(axis, step, length - step))
        mask, half = wider, half + step
    return mask


def widened(mask: torch.Tensor, reach: int) -> torch.Tensor:
    """The voxels of a mask and those up to ``reach`` from them along every axis."""
    for axis in range(mask.ndim):
        mask = _grown(mask, axis, reach)
    return mask
