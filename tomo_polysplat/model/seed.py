"""Gaussians to start from: a regular grid over the support of a first reconstruction."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.scan.geometry import VolumeGrid
from tomo_polysplat.settings import Settings

__all__ = ["Seeding", "seed_gaussians"]


@dataclass(frozen=True)
class Seeding:
    """What a cloud of seeds was made with.

    Attributes
    ----------
    spacing : float
        Distance of neighbouring seeds, in the grid's unit of length.
    material_free : (n,) bool array
        Gaussians near dense matter, whose material number is worth fitting.
    """

    spacing: float
    material_free: np.ndarray


def seed_gaussians(
    start: np.ndarray,
    curve: np.ndarray,
    grid: VolumeGrid,
    spacing: float,
    settings: Settings,
    polychromatic: bool,
    device: torch.device,
) -> tuple[Gaussians, Seeding]:
    """Seed the support of a start volume.

    Parameters
    ----------
    start : (nz, ny, nx) array
        First reconstruction in soft references.
    curve : (3,) array
        Mass attenuation of the three curves at the energy of ``start``, over that of the first.
    grid : VolumeGrid
        In the solver's coordinates.
    spacing : float
        Distance of the seeds in the grid's unit.
    """
    planar = grid.planar and grid.shape[0] == 1
    dims = 2 if planar else 3
    points = _lattice(grid, spacing, dims)
    value, nearby = _sample(start, points, grid, spacing, dims)
    keep = nearby > settings.support_level
    points, value = points[keep], np.maximum(value[keep], 0.02)
    u = np.full(len(points), settings.soft_u)
    free = np.zeros(len(points), bool)
    if polychromatic:
        u[value > settings.bone_level] = settings.bone_u
        u[value > settings.metal_level] = settings.metal_u
        free = _near_dense(start, points, grid, settings)
    mixture = np.stack([(1 - u) ** 2, 2 * u * (1 - u), u**2], 1)
    attenuation = mixture @ curve if polychromatic else np.ones(len(points))
    # A lattice of Gaussians of this height averages to the wanted value: mass per cell over mass per Gaussian.
    width = settings.seed_width
    density = value / attenuation / (math.sqrt(2 * math.pi) * width) ** dims

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32, device=device)

    rotation = np.zeros((len(points), 4))
    rotation[:, 0] = 1.0
    gaussians = Gaussians(
        tensor(points),
        tensor(np.full((len(points), dims), math.log(width * spacing))),
        tensor(rotation),
        tensor(density),
        tensor(u),
    )
    return gaussians, Seeding(spacing, free)


def _lattice(grid: VolumeGrid, spacing: float, dims: int) -> np.ndarray:
    """Points (n, 3) of a lattice centred in the grid's window; one layer when planar."""
    axes = []
    for k in range(3):
        count = max(1, round(grid.extent[k] / spacing)) if k < dims else 1
        axes.append(grid.lower[k] + (np.arange(count) + 0.5) * grid.extent[k] / count)
    x, y, z = np.meshgrid(*axes, indexing="ij")
    return np.stack([x, y, z], -1).reshape(-1, 3)


def _sample(start: np.ndarray, points: np.ndarray, grid: VolumeGrid, spacing: float, dims: int):
    """Mean of the start over the cell of each seed, and the largest such mean among it and its neighbours."""
    from scipy import ndimage

    cells = np.maximum(np.round(spacing / grid.voxel_size[::-1]).astype(int), 1)
    if dims == 2:
        cells[0] = 1
    mean = ndimage.uniform_filter(start, cells, mode="nearest") if cells.max() > 1 else start
    index = _voxel_of(points, grid)
    around = ndimage.maximum_filter(mean, [min(3, n) for n in mean.shape])
    return mean[index].astype(np.float64), around[index]


def _near_dense(start: np.ndarray, points: np.ndarray, grid: VolumeGrid, settings: Settings) -> np.ndarray:
    """Seeds within ``free_radius`` voxels of bone-like or denser matter."""
    from scipy import ndimage

    dense = start > settings.bone_level
    if not dense.any():
        return np.zeros(len(points), bool)
    distance = ndimage.distance_transform_edt(~dense)
    return distance[_voxel_of(points, grid)] <= settings.free_radius


def _voxel_of(points: np.ndarray, grid: VolumeGrid) -> tuple[np.ndarray, ...]:
    index = ((points - grid.lower) / grid.voxel_size).astype(int)[:, ::-1]
    return tuple(np.clip(index[:, k], 0, grid.shape[k] - 1) for k in range(3))
