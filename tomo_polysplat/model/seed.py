"""Gaussians to start from: a regular grid over the support of a first reconstruction.

The grid is twice as fine at metal, whose edges are where an error of position costs most.
"""

from __future__ import annotations

import itertools
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
    planar: bool,
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
        Wanted distance of the seeds in the grid's unit; a whole number of them fills the window.
    planar : bool
        Endless along z, for a scan of one plane.
    """
    dims = 2 if planar else 3
    start = _sharpened(start, settings.metal_level)
    points, size, cell, value = _lattices(start, grid, spacing, dims, settings)
    reach = settings.free_radius * float(grid.voxel_size[:dims].min())
    own, shared, group = _materials(start, points, value, grid, reach, settings, polychromatic)
    # Round, whatever the cell: thinner than the rays are apart, a Gaussian would be held by none. At this
    # height a lattice of them averages to the wanted value: the cell's integral over the Gaussian's.
    width = settings.seed_width * size
    attenuation = value * cell / (math.sqrt(2 * math.pi) * width) ** dims

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32, device=device)

    rotation = np.zeros((len(points), 4))
    rotation[:, 0] = 1.0
    gaussians = Gaussians(
        tensor(points),
        tensor(np.repeat(np.log(width)[:, None], dims, axis=1)),
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

    pieces, _ = ndimage.label(start > level)
    sharp = start.copy()
    for label, box in enumerate(ndimage.find_objects(pieces), 1):
        piece, old, new = pieces[box] == label, start[box], sharp[box]
        values = old[piece]
        core = piece & (old > 0.5 * np.quantile(values, 0.9))
        new[piece] = np.minimum(values, 1.0)
        new[core] = old[core] * (values.sum() / old[core].sum())
    return sharp


def _lattices(
    start: np.ndarray, grid: VolumeGrid, spacing: float, dims: int, settings: Settings
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points (n, 3) on the support; spacing, volume of the cell and the start's mean over it, (n,) each."""
    coarse, step = _lattice(grid, spacing, dims)
    metal = _reaches(start, coarse, grid, settings.metal_level, spacing)
    parts = []
    for points, share in ((coarse[~metal], 1.0), (_split(coarse[metal], step), 0.5)):
        value, nearby = _sample(start, points, grid, share * step)
        keep = nearby > settings.support_level
        every = np.ones(int(keep.sum()))
        cell = float(np.prod(share * step))
        parts.append((points[keep], share * spacing * every, cell * every, np.maximum(value[keep], _LEAST)))
    points, sizes, cells, values = (np.concatenate(arrays) for arrays in zip(*parts))
    return points, sizes, cells, values


def _lattice(grid: VolumeGrid, spacing: float, dims: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) of a lattice that fills the grid's window, and its steps (dims,); planar, in one layer."""
    counts = np.maximum(np.round(grid.extent / spacing).astype(int), 1)
    counts[dims:] = 1
    steps = grid.extent / counts
    x, y, z = np.meshgrid(
        *(low + (np.arange(n) + 0.5) * d for low, n, d in zip(grid.lower, counts, steps)), indexing="ij"
    )
    return np.stack([x, y, z], -1).reshape(-1, 3), steps[:dims]


def _sample(
    start: np.ndarray, points: np.ndarray, grid: VolumeGrid, cell: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the start over the cell of each seed, and the largest such mean among it and its neighbours."""
    from scipy import ndimage

    cells = np.ones(3, int)
    cells[3 - len(cell) :] = np.maximum(np.round(cell / grid.voxel_size[: len(cell)]).astype(int), 1)[::-1]
    mean = ndimage.uniform_filter(start, cells, mode="nearest") if cells.max() > 1 else start
    index = _voxel_of(points, grid)
    around = mean[index]
    for offset in itertools.product((-1, 0, 1), repeat=3):
        beside = tuple(np.clip(i + d, 0, n - 1) for i, d, n in zip(index, offset, mean.shape))
        around = np.maximum(around, mean[beside])
    return mean[index].astype(np.float64), around


def _split(points: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Every lattice point replaced by the 2^dims points of a lattice of half the steps in its cell."""
    dims = len(step)
    corners = np.stack(np.meshgrid(*[[-0.25, 0.25]] * dims, indexing="ij"), -1).reshape(-1, dims)
    offsets = np.zeros((len(corners), 3))
    offsets[:, :dims] = corners * step
    return (points[:, None] + offsets).reshape(-1, 3)


def _reaches(
    start: np.ndarray, points: np.ndarray, grid: VolumeGrid, level: float, reach: float
) -> np.ndarray:
    """Points within a distance, along every axis, of a voxel above a level."""
    from scipy import ndimage

    near = (start > level).astype(np.uint8)
    if not near.any():
        return np.zeros(len(points), bool)
    for axis, size in enumerate(grid.voxel_size[::-1]):
        # A whole number of voxels must not lose one to rounding.
        voxels = int(reach / size + 1e-6)
        near = ndimage.maximum_filter1d(near, 2 * voxels + 1, axis=axis, mode="nearest")
    return near[_voxel_of(points, grid)] > 0


def _materials(
    start: np.ndarray,
    points: np.ndarray,
    value: np.ndarray,
    grid: VolumeGrid,
    reach: float,
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
    group[_reaches(start, points, grid, settings.bone_level, reach)] = -1
    own[value > settings.bone_level] = settings.bone_u
    pieces, number = ndimage.label(start > settings.metal_level)
    piece = pieces[_voxel_of(points, grid)]
    group[piece > 0] = piece[piece > 0]
    return own, np.r_[settings.soft_u, np.full(number, settings.metal_u)], group


def _voxel_of(points: np.ndarray, grid: VolumeGrid) -> tuple[np.ndarray, ...]:
    index = ((points - grid.lower) / grid.voxel_size).astype(int)[:, ::-1]
    return tuple(np.clip(index[:, k], 0, grid.shape[k] - 1) for k in range(3))
