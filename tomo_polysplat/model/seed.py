"""Seed Gaussians on a regular grid over the support of a first reconstruction.

The grid is twice as fine at metal, because an error of position costs most at its edges. If there are fewer Gaussians
than the detector could tell apart, the grid is coarser, but twice as fine where the start varies, and three times as
fine at metal.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch

from tomo_polysplat.kernels.spatial_order import spatial_order
from tomo_polysplat.model.bone_numbers import start_numbers
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.model.seed_edges import edge_shapes
from tomo_polysplat.model.seed_samples import box_mean, largest_around, reaches, voxel_of
from tomo_polysplat.scan.geometry import VolumeGrid
from tomo_polysplat.settings import Settings

__all__ = ["Spacing", "seed_gaussians"]

# Attenuation, in soft references, of a seed in what looks like air: from zero it would not grow.
_LEAST = 0.02


class Spacing(NamedTuple):
    """How far apart seeds are.

    Attributes
    ----------
    mean : float
        Wanted distance in the grid's unit. It is changed so that a whole number fills the window.
    finer : float
        Share of the Gaussians, below 1, that lie where the start varies most, on a grid twice as fine as that of the
        rest. The total stays that of a grid with one distance.
    finest : float
        Distance of the closest seeds that the detector could tell apart. Seeds that are farther apart are made as thin
        as that across edges of the start (``seed_edges``). Infinity makes all of them round.
    """

    mean: float
    finer: float = 0.0
    finest: float = math.inf


def seed_gaussians(
    start: torch.Tensor,
    grid: VolumeGrid,
    spacing: Spacing,
    settings: Settings,
    polychromatic: bool,
    planar: bool,
) -> Gaussians:
    """Seed the support of a start volume.

    Parameters
    ----------
    start : (nz, ny, nx) tensor
        First reconstruction in soft references; the Gaussians are made on its device.
    grid : VolumeGrid
        In the solver's coordinates.
    spacing : Spacing
    settings : Settings
    polychromatic : bool
        Whether seeds have material numbers of their own.
    planar : bool
        Endless along z, for a scan of one plane.
    """
    dims = 2 if planar else 3
    start = _sharpened(start, settings)
    points, size, cell, value = _lattices(start, grid, spacing, dims, settings)
    if polychromatic:
        reach = settings.free_radius * float(grid.voxel_size[:dims].min())
        own, shared, group = _materials(start, points, value, grid, reach, settings)
    else:
        own, shared = torch.full_like(value, settings.soft_u), value.new_tensor([settings.soft_u])
        group = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    # Round, whatever the shape of the cell: a Gaussian thinner than the distance of rays could lie between them. With
    # this height, the cell's integral over the Gaussian's, a lattice of them averages to the wanted value.
    width = settings.seed_width * size
    attenuation = value * cell / (math.sqrt(2 * math.pi) * width) ** dims
    rotation, thinner = edge_shapes(start, points, size, grid, settings, spacing.finest, dims)
    log_scale = width.log()[:, None] + thinner
    parts = (points, log_scale, rotation, attenuation, own, shared, rotation.new_tensor([settings.blur]))
    position, log_scale, rotation, attenuation, own, shared, blur = (part.float() for part in parts)
    gaussians = Gaussians(position, log_scale, rotation, attenuation, own, shared, group, blur)
    # The kernels need neighbours in space beside each other in memory.
    order = spatial_order(gaussians.position)
    return gaussians.select(order)


def _pieces(mask: torch.Tensor) -> tuple[tuple[slice, ...], np.ndarray, int]:
    """The box around all True voxels, an array of it with connected pieces numbered from 1, and their number."""
    from scipy import ndimage

    box = []
    for others in ((1, 2), (0, 2), (0, 1)):
        some = mask.any(dim=others[1]).any(dim=others[0]).nonzero()[:, 0]
        box.append(slice(int(some[0]), int(some[-1]) + 1) if len(some) else slice(0, 1))
    pieces, number = ndimage.label(mask[tuple(box)].cpu().numpy())
    return tuple(box), pieces, number


def _metal(start: torch.Tensor, settings: Settings) -> torch.Tensor:
    """Voxels of metal, and voxels connected to them down to the level of its rim."""
    core = start > settings.metal_level
    if not settings.metal_rim:
        return core
    box, pieces, _ = _pieces(core | (start > settings.metal_rim))
    labels = torch.from_numpy(pieces).to(start.device)
    touched = labels[core[box]].unique()
    metal = torch.zeros_like(core)
    metal[box] = torch.isin(labels, touched[touched > 0])
    return metal


def _sharpened(start: torch.Tensor, settings: Settings) -> torch.Tensor:
    """The start with every piece of metal cut at half its height. Its mass is kept, its rim becomes soft matter.

    Filtered backprojection blurs, and the blurred rim of metal is many times as bright as the matter that lies there.
    """
    from scipy import ndimage

    box, pieces, _ = _pieces(_metal(start, settings))
    old_part = start[box].cpu().numpy()
    new_part = old_part.copy()
    for label, where in enumerate(ndimage.find_objects(pieces), 1):
        piece, old, new = pieces[where] == label, old_part[where], new_part[where]
        values = old[piece]
        core = piece & (old > 0.5 * np.quantile(values, 0.9))
        new[piece] = np.minimum(values, 1.0)
        new[core] = old[core] * (values.sum() / old[core].sum())
    sharp = start.clone()
    sharp[box] = torch.from_numpy(new_part).to(start.device)
    return sharp


def _lattices(
    start: torch.Tensor, grid: VolumeGrid, spacing: Spacing, dims: int, settings: Settings
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Points (n, 3) on the support; spacing, volume of the cell and the start's mean over it, (n,) each."""
    finer = spacing.finer
    distance = spacing.mean / (1 - finer) ** (1 / dims)
    coarse, step = _lattice(grid, distance, dims, start.device)
    metal = reaches(start, coarse, grid, settings.metal_level, distance)
    parted = {1: ~metal, 2: metal}
    if finer:
        varied = _varied(start, coarse, grid, step, settings, finer) & ~metal
        parted = {1: ~(metal | varied), 2: varied, 3: metal}
    parts = []
    for times, chosen in parted.items():
        points, share = _split(coarse[chosen], step, times), 1 / times
        value, nearby = _sample(start, points, grid, share * step)
        keep = nearby > settings.support_level
        points, value = points[keep], value[keep].clamp(min=_LEAST)
        cell = float(np.prod(share * step))
        parts.append((points, torch.full_like(value, share * distance), torch.full_like(value, cell), value))
    points, sizes, cells, values = (torch.cat(tensors) for tensors in zip(*parts))
    return points, sizes, cells, values


def _varied(
    start: torch.Tensor,
    points: torch.Tensor,
    grid: VolumeGrid,
    step: np.ndarray,
    settings: Settings,
    finer: float,
) -> torch.Tensor:
    """Seeds in whose cells the start varies most; once split, they are the share ``finer`` of all Gaussians."""
    dims = len(step)
    supported = _sample(start, points, grid, step)[1] > settings.support_level
    # Splitting one of n cells adds 2^dims - 1 Gaussians; there may be n finer / (1 - finer) more.
    most = int(int(supported.sum()) * finer / (1 - finer) / (2**dims - 1))
    # Means over cells of half a step suppress noise; the middles of such cells are half a step apart.
    half = np.ones(3, int)
    half[3 - dims :] = np.maximum(np.round(0.5 * step / grid.voxel_size[:dims]).astype(int), 1)[::-1]
    mean = box_mean(start.clamp(0.0, settings.metal_level), half)
    reach = [int(n) if size > 1 else 0 for n, size in zip(half, start.shape)]
    voxels = voxel_of(points, grid)
    spread = largest_around(mean, reach)[voxels]
    # In place, as it is nobody else's.
    spread = spread + largest_around(mean.neg_(), reach)[voxels]
    chosen = torch.zeros_like(supported)
    chosen[spread.masked_fill(~supported, -1.0).topk(min(most, len(points))).indices] = True
    return chosen & supported


def _lattice(
    grid: VolumeGrid, spacing: float, dims: int, device: torch.device
) -> tuple[torch.Tensor, np.ndarray]:
    """Points (n, 3) of a lattice that fills the grid's window, and its steps (dims,); planar, in one layer."""
    counts = np.maximum(np.round(grid.extent / spacing).astype(int), 1)
    counts[dims:] = 1
    steps = grid.extent / counts
    axes = [low + (np.arange(n) + 0.5) * d for low, n, d in zip(grid.lower, counts, steps)]
    x, y, z = torch.meshgrid(*(torch.as_tensor(axis, device=device) for axis in axes), indexing="ij")
    return torch.stack([x, y, z], -1).reshape(-1, 3), steps[:dims]


def _sample(
    start: torch.Tensor, points: torch.Tensor, grid: VolumeGrid, cell: np.ndarray
) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean of the start over the cell of each seed, and the largest such mean among it and its neighbours."""
    cells = np.ones(3, int)
    cells[3 - len(cell) :] = np.maximum(np.round(cell / grid.voxel_size[: len(cell)]).astype(int), 1)[::-1]
    mean, index = box_mean(start, cells), voxel_of(points, grid)
    return mean[index].double(), largest_around(mean, [1, 1, 1])[index]


def _split(points: torch.Tensor, step: np.ndarray, times: int) -> torch.Tensor:
    """Replace every lattice point by those of a lattice in its cell that is ``times`` as fine."""
    dims = len(step)
    along = (np.arange(times) + 0.5) / times - 0.5
    corners = np.stack(np.meshgrid(*[along] * dims, indexing="ij"), -1).reshape(-1, dims)
    offsets = np.zeros((len(corners), 3))
    offsets[:, :dims] = corners * step
    return (points[:, None] + torch.from_numpy(offsets).to(points.device)).reshape(-1, 3)


def _materials(
    start: torch.Tensor,
    points: torch.Tensor,
    value: torch.Tensor,
    grid: VolumeGrid,
    reach: float,
    settings: Settings,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Material numbers of their own, of the groups, and the group of every seed.

    Group 0 is the soft matter away from anything dense. Then comes one group for every separate piece of metal. In
    between, the start does not tell materials reliably, and every Gaussian has a number of its own.
    """
    group = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    own = start_numbers(value, settings)
    group[reaches(start, points, grid, settings.bone_level, reach)] = -1
    box, pieces, number = _pieces(_metal(start, settings))
    labels = torch.zeros(start.shape, dtype=torch.int32, device=start.device)
    labels[box] = torch.from_numpy(pieces).to(start.device)
    piece = labels[voxel_of(points, grid)].long()
    group = torch.where(piece > 0, piece, group)
    return own, value.new_tensor([settings.soft_u, *[settings.metal_u] * number]), group
