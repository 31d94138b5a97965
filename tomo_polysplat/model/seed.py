"""Gaussians to start from: a regular grid over the support of a first reconstruction.

The grid is twice as fine at metal, whose edges are where an error of position costs most.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from tomo_polysplat.kernels.spatial_order import spatial_order
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.scan.geometry import VolumeGrid
from tomo_polysplat.settings import Settings

__all__ = ["seed_gaussians"]

# Attenuation, in soft references, that a seed in what looks like air starts from: from zero it would not grow.
_LEAST = 0.02


def seed_gaussians(
    start: np.ndarray,
    grid: VolumeGrid,
    spacing: float,
    settings: Settings,
    polychromatic: bool,
    device: torch.device,
) -> Gaussians:
    """Seed the support of a start volume.

    Parameters
    ----------
    start : (nz, ny, nx) array
        First reconstruction in soft references.
    grid : VolumeGrid
        In the solver's coordinates.
    spacing : float
        Distance of the seeds in the grid's unit.
    """
    dims = 2 if grid.planar else 3
    start = _sharpened(start, settings.metal_level)
    points, size, value = _lattices(start, grid, spacing, dims, settings)
    own, shared, group = _materials(start, points, value, grid, settings, polychromatic)
    # A lattice of Gaussians of this height averages to the wanted value: the cell's integral over the
    # Gaussian's.
    width = settings.seed_width
    attenuation = value / (math.sqrt(2 * math.pi) * width) ** dims

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32, device=device)

    rotation = np.zeros((len(points), 4))
    rotation[:, 0] = 1.0
    gaussians = Gaussians(
        tensor(points),
        tensor(np.repeat(np.log(width * size)[:, None], dims, axis=1)),
        tensor(rotation),
        tensor(attenuation),
        tensor(own),
        tensor(shared),
        torch.as_tensor(group, device=device),
    )
    # Neighbours in space beside each other in memory, which the kernels use.
    order = spatial_order(gaussians.position)
    return gaussians.select(order)


def _sharpened(start: np.ndarray, level: float) -> np.ndarray:
    """The start with every piece of metal cut at half its height, its mass kept and its rim made soft matter.

    Filtered backprojection blurs; the blurred rim of metal is many times as bright as what really lies there.
    """
    from scipy import ndimage

    pieces, number = ndimage.label(start > level)
    sharp = start.copy()
    for label in range(1, number + 1):
        piece = pieces == label
        values = start[piece]
        core = piece & (start > 0.5 * np.quantile(values, 0.9))
        sharp[piece] = np.minimum(values, 1.0)
        sharp[core] = start[core] * (values.sum() / start[core].sum())
    return sharp


def _lattices(
    start: np.ndarray, grid: VolumeGrid, spacing: float, dims: int, settings: Settings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (n, 3) on the support, the spacing at each and the start's mean over the cell of each."""
    coarse = _lattice(grid, spacing, dims)
    metal = _reaches(start, coarse, grid, settings.metal_level, spacing)
    parts = []
    for points, size in ((coarse[~metal], spacing), (_split(coarse[metal], spacing, dims), spacing / 2)):
        value, nearby = _sample(start, points, grid, size, dims)
        keep = nearby > settings.support_level
        parts.append((points[keep], np.full(keep.sum(), size), np.maximum(value[keep], _LEAST)))
    points, size, value = (np.concatenate(arrays) for arrays in zip(*parts))
    return points, size, value


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


def _split(points: np.ndarray, spacing: float, dims: int) -> np.ndarray:
    """Every lattice point replaced by the 2^dims points of a lattice of half the spacing in its cell."""
    corners = np.stack(np.meshgrid(*[[-0.25, 0.25]] * dims, indexing="ij"), -1).reshape(-1, dims)
    offsets = np.zeros((len(corners), 3))
    offsets[:, :dims] = corners * spacing
    return (points[:, None] + offsets).reshape(-1, 3)


def _reaches(
    start: np.ndarray, points: np.ndarray, grid: VolumeGrid, level: float, reach: float
) -> np.ndarray:
    """Points within a distance of a voxel above a level."""
    from scipy import ndimage

    above = start > level
    if not above.any():
        return np.zeros(len(points), bool)
    distance = ndimage.distance_transform_edt(~above, sampling=grid.voxel_size[::-1])
    return distance[_voxel_of(points, grid)] <= reach


def _materials(
    start: np.ndarray,
    points: np.ndarray,
    value: np.ndarray,
    grid: VolumeGrid,
    settings: Settings,
    polychromatic: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Material numbers of their own, of the groups, and the group of every seed.

    Group 0 is the soft matter away from anything dense; then comes one for every separate piece of metal. In
    between, where the start cannot be trusted to tell what is what, every Gaussian has its own.
    """
    from scipy import ndimage

    group = np.zeros(len(points), np.int64)
    own = np.full(len(points), settings.soft_u)
    if not polychromatic:
        return own, np.array([settings.soft_u]), group
    reach = settings.free_radius * float(grid.voxel_size[: 2 if grid.planar else 3].min())
    group[_reaches(start, points, grid, settings.bone_level, reach)] = -1
    own[value > settings.bone_level] = settings.bone_u
    pieces, number = ndimage.label(start > settings.metal_level)
    piece = pieces[_voxel_of(points, grid)]
    group[piece > 0] = piece[piece > 0]
    return own, np.r_[settings.soft_u, np.full(number, settings.metal_u)], group


def _voxel_of(points: np.ndarray, grid: VolumeGrid) -> tuple[np.ndarray, ...]:
    index = ((points - grid.lower) / grid.voxel_size).astype(int)[:, ::-1]
    return tuple(np.clip(index[:, k], 0, grid.shape[k] - 1) for k in range(3))
