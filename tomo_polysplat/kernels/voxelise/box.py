"""The block of voxels a kernel samples Gaussians on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

__all__ = ["VoxelBox"]


@dataclass(frozen=True)
class VoxelBox:
    """Voxel centres ``first + index * spacing``.

    Parameters
    ----------
    first : (3,) float64
        Centre (x, y, z) of voxel (0, 0, 0).
    spacing : (3,) float64
        Distance of neighbouring centres along x, y, z.
    shape : (nz, ny, nx)
    whole : bool
        Whether wide Gaussians count over all of a voxel, and not at its centre alone.
    levels : int
        At how many heights of each slice all its rays run, evenly spread: what lies between is not measured. Else 0.
    """

    first: np.ndarray
    spacing: np.ndarray
    shape: tuple[int, int, int]
    whole: bool = True
    levels: int = 0

    def part(self, start: tuple[int, int, int], shape: tuple[int, int, int]) -> VoxelBox:
        """The sub-block of ``shape`` that begins at voxel ``start`` (z, y, x)."""
        return replace(self, first=self.first + np.array(start[::-1]) * self.spacing, shape=shape)

    def refined(self, factor: np.ndarray) -> VoxelBox:
        """The same block cut into ``factor`` (z, y, x) times as many voxels an axis."""
        spacing = self.spacing / factor[::-1]
        shape = tuple(int(n * f) for n, f in zip(self.shape, factor))
        first = self.first - 0.5 * (self.spacing - spacing)
        return replace(self, first=first, spacing=spacing, shape=shape)  # type: ignore[arg-type]

    def voxels_of(self, points: torch.Tensor) -> torch.Tensor:
        """(n, 3) indices (z, y, x) of the voxels that hold points (n, 3), or of the nearest ones."""
        first, spacing, size = (
            points.new_tensor(values) for values in (self.first, self.spacing, self.shape[::-1])
        )
        index = ((points - first) / spacing).round().clamp(min=0)
        return torch.minimum(index, size - 1).long().flip(1)
