"""Filtered backprojection slab by slab of z: of the detector a slab needs the rows alone that its rays end in."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from tomo_polysplat.free_memory import free_bytes, give_back, in_gigabytes
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.level import Level, LevelRows
from tomo_polysplat.start.orbit import Orbit
from tomo_polysplat.start.shadow import corners_of, ellipse_of, margins, slices_seen

if TYPE_CHECKING:
    import torch

    from tomo_polysplat.start.whole_rows import WholeRows

__all__ = ["fdk_cuda", "fdk_of_slabs", "fdk_on_device", "in_one_piece", "rows_of", "slab_of", "slabs"]

logger = logging.getLogger(__name__)

# Rows beyond those that voxels' centres fall on: the next one is interpolated with.
_MARGIN = 2
# Bytes on a GPU: of a number of the views of a slab that are filtered and backprojected together (as the filter takes
# them, ASTRA's sinogram, and the texture that it makes of that), of a voxel of it (and whether it is finite), and what
# the filter takes besides.
_OF_RAY, _OF_VOXEL, _FILTER = 12, 5, 4 << 27
# Of what is free: the rest is for what ASTRA's own context takes. And how often less is tried where that was too much.
_SHARE, _TIMES = 0.8, 3


def slabs(slices: int, depth: int, halo: int = 0) -> Iterator[tuple[slice, int, int]]:
    """The slices of each slab, and the first and the one behind the last with a halo at both ends."""
    for first in range(0, slices, depth):
        last = min(first + depth, slices)
        yield slice(first, last), max(first - halo, 0), min(last + halo, slices)


def slab_of(grid: VolumeGrid, first: int, last: int) -> VolumeGrid:
    """The slices of a grid from the first up to, and without, the last."""
    _, rows, columns = grid.shape
    return grid.box((slice(first, last), slice(0, rows), slice(0, columns)))


def rows_of(geometry: Geometry, grid: VolumeGrid) -> tuple[int, int]:
    """The first row of the detector that rays through a grid end in, and the one behind the last; two at least."""
    rows = geometry.project_points(corners_of(grid))[..., 1]
    if not np.isfinite(rows).all():
        return 0, geometry.rows
    first = int(np.clip(np.floor(rows.min()) - _MARGIN, 0, max(geometry.rows - 2, 0)))
    last = int(np.clip(np.ceil(rows.max()) + _MARGIN + 1, min(first + 2, geometry.rows), geometry.rows))
    return first, last


def fdk_of_slabs(
    make: Callable[[tuple[int, int], Geometry, VolumeGrid], torch.Tensor],
    geometry: Geometry,
    grid: VolumeGrid,
    depth: int,
    whole: torch.Tensor,
) -> None:
    """Fill a volume by slabs of so many slices.

    Parameters
    ----------
    make : callable
        Gets the rows (first, behind the last) that a slab needs, the geometry of these alone and the slab's grid, and
        gives its volume.
    geometry, grid : Geometry, VolumeGrid
        Of a scan that filtered backprojection fits.
    depth : int
    whole : (nz, ny, nx) tensor
        The same as made in one piece, to rounding; it may lie anywhere. A tilted detector that is beside the axis has
        more rays measured twice in some slabs than in all.
    """
    for wanted, first, last in slabs(grid.shape[0], depth):
        slab = slab_of(grid, first, last)
        rows = rows_of(geometry, slab)
        whole[wanted] = make(rows, geometry.cropped(rows, (0, geometry.columns)), slab)


def fdk_cuda(
    projections: np.ndarray,
    geometry: Geometry,
    grid: VolumeGrid,
    orbit: Orbit,
    *,
    filter_name: str = "ram-lak",
    device: str = "cuda",
) -> np.ndarray:
    """`fdk` on a GPU for a scan that `suits_fdk_cuda`; parameters and result are the same."""
    import torch

    values = torch.from_numpy(np.ascontiguousarray(projections, dtype=np.float32))
    return fdk_on_device(values, geometry, grid, orbit, filter_name, torch.device(device)).cpu().numpy()


def fdk_on_device(
    projections: torch.Tensor | WholeRows,
    geometry: Geometry,
    grid: VolumeGrid,
    orbit: Orbit,
    filter_name: str,
    device: torch.device,
) -> torch.Tensor:
    """`fdk_cuda_tensor` of projections that may be on the host, in one piece or by slabs, as there is room.

    Returns
    -------
    (nz, ny, nx) tensor
        On the device; on the host where that has no room for it.

    Raises
    ------
    RuntimeError
        If the device has no room for a slab either; with bytes needed and bytes free.
    """
    import torch

    from tomo_polysplat.start.astra_fdk import fdk_cuda_tensor

    level = Level(geometry)
    flat = level.geometry

    def make(rows: tuple[int, int], cropped: Geometry, slab: VolumeGrid) -> torch.Tensor:
        return fdk_cuda_tensor(LevelRows(level, projections, rows, device), cropped, slab, orbit, filter_name)

    def tried(depth: int, place: torch.device) -> torch.Tensor:
        if depth >= nz and place == device:
            whole = make((0, flat.rows), flat, grid)
        else:
            whole = torch.empty(grid.shape, dtype=torch.float32, device=place)
            fdk_of_slabs(make, flat, grid, depth, whole)
            logger.info("Filtered backprojection by slabs of %d of %d slices.", depth, nz)
        whole[torch.from_numpy(~slices_seen(geometry, grid, orbit)).to(place)] = 0.0
        return whole

    nz, ny, nx = grid.shape
    of_whole = 4 * nz * ny * nx
    for attempt in range(_TIMES):
        room = _SHARE * free_bytes(device) / 2**attempt
        depth = _depth(flat, grid, room)
        # A second volume of this size is what whatever looks at it takes at least.
        place = device if 2 * of_whole < room else torch.device("cpu")
        if depth < nz and place.type == "cuda":
            depth = _depth(flat, grid, room - of_whole)
        try:
            return tried(depth, place)
        except RuntimeError as problem:
            if attempt + 1 == _TIMES or depth == 1:
                raise
            logger.info("%s Slabs are tried that take less than %s.", problem, in_gigabytes(room / 2))
        # What torch holds for later is of no use to ASTRA; only now does the error no longer hold the tensors.
        give_back()
    raise AssertionError("unreachable")


def in_one_piece(projections: torch.Tensor | WholeRows, level: Level, grid: VolumeGrid) -> bool:
    """Whether the device of the projections has room to make a volume of theirs in one piece; always on the host."""
    if not projections.is_cuda:
        return True
    room = _SHARE * free_bytes(projections.device)
    return _depth(level.geometry, grid, room) == grid.shape[0] and 8 * math.prod(grid.shape) < room


def _depth(geometry: Geometry, grid: VolumeGrid, room: float) -> int:
    """Slices of a slab for which there is room."""
    from tomo_polysplat.start.astra_fdk import views_at_once

    nz, ny, nx = grid.shape
    beyond = sum(margins(geometry, ellipse_of(grid)))
    # In the middle: nearest to the source's plane, where the cone is as wide as anywhere along the axis.
    depth = nz
    while depth > 1:
        first = (nz - depth) // 2
        low, high = rows_of(geometry, slab_of(grid, first, first + depth))
        pixels = (high - low) * (geometry.columns + beyond)
        rays = min(geometry.views, views_at_once(pixels)) * pixels
        if _OF_RAY * rays + _OF_VOXEL * depth * ny * nx + _FILTER <= room:
            break
        depth = -(-depth // 2)
    return depth
