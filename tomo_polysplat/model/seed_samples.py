"""Values of a start volume at seeds."""

from __future__ import annotations

import numpy as np
import torch

from tomo_polysplat.scan.geometry import VolumeGrid

__all__ = ["box_mean", "reaches", "voxel_of", "widened"]


def box_mean(volume: torch.Tensor, cells: np.ndarray) -> torch.Tensor:
    """Mean over (z, y, x) voxels around each one; beyond the volume its outermost values go on."""
    if cells.max() == 1:
        return volume
    margins = [side for n in cells[::-1].tolist() for side in (n // 2, n - 1 - n // 2)]
    padded = torch.nn.functional.pad(volume[None, None], margins, mode="replicate")
    return torch.nn.functional.avg_pool3d(padded, cells.tolist(), stride=1)[0, 0]


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
