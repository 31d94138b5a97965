"""A start volume as seeds see it."""

from __future__ import annotations

import numpy as np
import torch

from tomo_polysplat.scan.geometry import VolumeGrid

__all__ = ["box_mean", "voxel_of"]


def box_mean(volume: torch.Tensor, cells: np.ndarray) -> torch.Tensor:
    """Mean over (z, y, x) voxels about each one; the volume's faces go on beyond it."""
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
