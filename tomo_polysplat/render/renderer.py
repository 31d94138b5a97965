"""Gaussians to detector images and to voxels."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import torch

from tomo_polysplat.kernels.project.autograd import project
from tomo_polysplat.kernels.project.reference import whitening_matrices
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.kernels.voxelise.autograd import voxelise
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid

__all__ = [
    "RAY_CUTOFF",
    "VOXEL_CUTOFF",
    "detector_views",
    "project_gaussians",
    "voxel_box",
    "voxelise_gaussians",
    "voxelise_means",
    "voxelise_peaks",
]

# Where Gaussians end, in deviations: projected, and in a volume. Both keep the same mass, 1 - exp(-9/2): the second is
# the solution c of erf(c/sqrt 2) - sqrt(2/pi) c exp(-c^2/2) = 1 - exp(-9/2).
RAY_CUTOFF, VOXEL_CUTOFF = 3.0, 3.33424
# Samples per voxel and axis for thin Gaussians, which are sampled in groups that need as many: twice as many samples an
# axis are eight times as many points. The last number is the most samples held at once.
_SAMPLES, _SLAB = (3, 6, 12, 24), 1 << 25
# Samples per voxel and axis for the largest value in a voxel.
_PEAK_SAMPLES = 5
# Distance of samples in deviations. The mean of a Gaussian over such samples is right within
# 2 exp(-2 pi^2 / 1.67^2) = 0.2 % wherever they fall (Poisson's summation formula).
_SAMPLE_STEP = 5 / 3
# Distance of seeds in voxels up to which a cloud can be as sharp as voxels. A coarser one is not, nor are the round
# seeds of slices, and means would blur them once more (docs/decisions/smallest_scale.md).
_FINE = 1.4
# Heights that a ray changes by on its way, and rows are apart, in those of slices, which then have one row each.
_LEVEL, _ROW = 0.5, 0.8
# How far a row may run beside the middle of its slice, in its heights: half of the least deviation of a Gaussian.
_BESIDE_MIDDLE = 0.1
# Rounding, as a share of a sample: the least deviation that a fit allows needs a whole number of samples.
_ROUNDING = 1e-3


def detector_views(geometry: Geometry, planar: bool) -> DetectorViews:
    """The arrays of a geometry that the kernels need."""
    cone = geometry.beam == "cone"
    direction = geometry.corner - geometry.origin if cone else geometry.origin
    matrix = np.stack([geometry.u, geometry.v, direction], axis=2)
    # A geometry's arrays are read-only, which kernels would be compiled for once more.
    origin = np.array(geometry.origin if cone else geometry.corner)
    return DetectorViews(cone, origin, matrix, geometry.rows, geometry.columns, planar)


def voxel_box(grid: VolumeGrid, geometry: Geometry | None = None, distance: float = 0.0) -> VoxelBox:
    """All voxels of a grid, as rays of a geometry and a cloud of seeds so many voxels apart show them."""
    slices = geometry is not None and _by_slices(geometry, grid)
    whole = distance <= _FINE and not slices
    levels = int(geometry is not None and slices and _in_middles(geometry, grid))
    return VoxelBox(grid.lower + 0.5 * grid.voxel_size, grid.voxel_size, grid.shape, whole, levels)


def _by_slices(geometry: Geometry, grid: VolumeGrid) -> bool:
    """Whether rays run within slices: within a single one, or parallel with hardly more than one row a slice."""
    if geometry.planar and grid.planar:
        return True
    if geometry.beam != "parallel":
        return False
    direction, height = geometry.origin, float(grid.voxel_size[2])
    level = np.abs(direction[:, 2]) * grid.extent[:2].max() < _LEVEL * height * np.linalg.norm(
        direction, axis=1
    )
    return bool(level.all() and (np.abs(geometry.v[:, 2]) > _ROW * height).all())


def _in_middles(geometry: Geometry, grid: VolumeGrid) -> bool:
    """Whether a row runs through the middle of each slice that the detector sees, along all of the row."""
    height = float(grid.voxel_size[2])
    middles = grid.lower[2] + height * (0.5 + np.arange(grid.shape[0]))
    row = (middles - geometry.corner[:, 2:]) / geometry.v[:, 2:]
    seen = (row > -0.5) & (row < geometry.rows - 0.5)
    beside = np.abs(row - np.rint(row)) * np.abs(geometry.v[:, 2:])
    risen = np.abs(geometry.u[:, 2]).max() * geometry.columns
    return bool(seen.any() and max(beside[seen].max(), risen) < _BESIDE_MIDDLE * height)


def project_gaussians(
    gaussians: Gaussians,
    weights: torch.Tensor,
    views: DetectorViews,
    kernel: str,
    vectors: torch.Tensor | None = None,
) -> tuple[torch.Tensor, int]:
    """(channels, views, rows, columns) line integrals, and the pairs skipped at the source plane.

    ``vectors``, (views, 4, 3) float64 on the CPU, take the place of ``views.vectors`` and get a gradient.
    """
    return project(
        gaussians.position,
        gaussians.scale(),
        gaussians.rotation,
        weights,
        views,
        kernel=kernel,
        cutoff=RAY_CUTOFF,
        vectors=vectors,
    )


def voxelise_gaussians(
    gaussians: Gaussians, weights: torch.Tensor, box: VoxelBox, kernel: str
) -> torch.Tensor:
    """(channels, nz, ny, nx) sums of the Gaussians at voxel centres."""
    return voxelise(
        gaussians.position,
        gaussians.scale(),
        gaussians.rotation,
        weights,
        box,
        kernel=kernel,
        cutoff=VOXEL_CUTOFF,
    )


def voxelise_means(gaussians: Gaussians, weights: torch.Tensor, box: VoxelBox, kernel: str) -> torch.Tensor:
    """(channels, nz, ny, nx) means of the Gaussians over the voxels; not differentiable.

    Whether a Gaussian thinner than half a voxel shows at voxel centres depends on where it lies between them. So thin
    Gaussians are sampled at several points per voxel, and at more along the long edges of an oblong voxel. The mean of
    a wider one is that of a Gaussian of `_widened` variance at the centre. Slices show the heights that rays see.
    """
    dims = gaussians.log_scale.shape[1]
    edge = float(box.spacing[:dims].max())
    thinnest = gaussians.log_scale.exp().amin(dim=1) / edge
    wide = (thinnest >= 0.5).nonzero()[:, 0]
    volume = voxelise_gaussians(*_widened(gaussians.select(wide), weights[:, wide], box), box, kernel)
    enough = [0.5, *(1 / (_SAMPLE_STEP * (n + _ROUNDING)) for n in _SAMPLES[:-1]), 0.0]
    for least, below in zip(enough[1:], enough):
        thin = ((thinnest >= least) & (thinnest < below)).nonzero()[:, 0]
        some = gaussians.select(thin)
        first, shape = _reached(some, box)
        if not all(shape):
            continue
        fine = _samples(box, edge * float(thinnest[thin].min()), planar=dims == 2)
        part = volume[:, first[0] :, first[1] :, first[2] :][:, : shape[0], : shape[1], : shape[2]]
        for where, means in _of_samples(
            some, weights[:, thin], box.part(first, shape), kernel, fine, torch.mean
        ):
            part[where] += means
    return volume


def _widened(gaussians: Gaussians, weights: torch.Tensor, box: VoxelBox) -> tuple[Gaussians, torch.Tensor]:
    """Gaussians whose values at voxel centres are means over the voxels, and their weights, of the same mass.

    A mean over an edge h adds its variance, h^2 / 12. The peak of a Gaussian of half a voxel is 1 % off along each axis
    then, that of one voxel 0.1 %, as its fourth moment differs.
    """
    if not box.whole:
        return gaussians, weights
    dims = gaussians.log_scale.shape[1]
    of_edges = box.spacing[:dims] ** 2 / 12
    own = gaussians.log_scale.exp().square()
    if np.allclose(of_edges, of_edges[0]):
        wider = own + float(of_edges[0])
    else:
        axes = whitening_matrices(torch.ones_like(gaussians.position), gaussians.rotation)[:, :dims, :dims]
        wider = own + axes.square() @ torch.from_numpy(of_edges).to(axes)
    return replace(gaussians, log_scale=0.5 * wider.log()), weights * (own / wider).prod(dim=1).sqrt()


def _reached(gaussians: Gaussians, box: VoxelBox) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
    """First voxel (z, y, x) and shape of the part of a box that Gaussians reach."""
    if not len(gaussians):
        return (0, 0, 0), (0, 0, 0)
    dims = gaussians.log_scale.shape[1]
    centre = gaussians.position[:, :dims]
    reach = VOXEL_CUTOFF * gaussians.log_scale.exp().amax(dim=1, keepdim=True)
    ends = torch.stack([(centre - reach).amin(dim=0), (centre + reach).amax(dim=0)]).double().cpu().numpy()
    count = np.array(box.shape[::-1])
    first, end = np.zeros(3, int), count.copy()
    # A voxel reaches half of an edge to either side of its centre.
    low, high = np.floor((ends - box.first[:dims]) / box.spacing[:dims] + 0.5)
    first[:dims] = np.clip(low, 0, count[:dims])
    end[:dims] = np.clip(high + 1, first[:dims], count[:dims])
    return tuple(first[::-1].tolist()), tuple((end - first)[::-1].tolist())  # type: ignore[return-value]


def voxelise_peaks(gaussians: Gaussians, weights: torch.Tensor, box: VoxelBox, kernel: str) -> torch.Tensor:
    """(channels, nz, ny, nx) largest sum of the Gaussians at points in each voxel; not differentiable."""
    fine = _at_heights_of_rays(np.full(3, _PEAK_SAMPLES), box, planar=gaussians.planar)
    volume = weights.new_empty((len(weights), *box.shape))
    for where, peaks in _of_samples(gaussians, weights, box, kernel, fine, torch.amax):
        volume[where] = peaks
    return volume


def _of_samples(
    gaussians: Gaussians,
    weights: torch.Tensor,
    box: VoxelBox,
    kernel: str,
    fine: np.ndarray,
    what: Callable[..., torch.Tensor],
) -> Iterator[tuple[tuple[slice, ...], torch.Tensor]]:
    """Yield part by part of the volume: its place, and values made from ``fine`` (z, y, x) points of each voxel."""
    nz, ny, nx = box.shape
    line = int(np.prod(fine)) * nx
    rows = min(ny, max(1, _SLAB // line))
    depth = max(1, _SLAB // (line * rows))
    for z in range(0, nz, depth):
        for y in range(0, ny, rows):
            shape = (min(depth, nz - z), min(rows, ny - y), nx)
            samples = voxelise_gaussians(gaussians, weights, box.part((z, y, 0), shape).refined(fine), kernel)
            blocks = [n for pair in zip(shape, fine) for n in pair]
            where = (slice(None), slice(z, z + shape[0]), slice(y, y + shape[1]))
            yield where, what(samples.reshape(len(weights), *blocks), dim=(2, 4, 6))


def _samples(box: VoxelBox, thinnest: float, *, planar: bool) -> np.ndarray:
    """(z, y, x) samples per voxel for Gaussians whose least deviation is ``thinnest``."""
    needed = np.ceil(box.spacing[::-1] / (_SAMPLE_STEP * thinnest) - _ROUNDING)
    return _at_heights_of_rays(np.clip(needed, _SAMPLES[0], _SAMPLES[-1]).astype(int), box, planar=planar)


def _at_heights_of_rays(counts: np.ndarray, box: VoxelBox, *, planar: bool) -> np.ndarray:
    """(z, y, x) samples per voxel, those along z at the heights of rays where these are all that is measured."""
    levels = 1 if planar else box.levels
    return np.array([levels, *counts[1:]]) if levels else counts
