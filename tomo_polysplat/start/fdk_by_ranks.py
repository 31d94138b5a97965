"""Filtered backprojection by all ranks: each makes a slab of z, of the rows of the detector that it needs."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from tomo_polysplat.free_memory import give_back
from tomo_polysplat.rank_work import any_lacks, helpers
from tomo_polysplat.ranks import Ranks, part_of
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.level import Level, LevelRows
from tomo_polysplat.start.orbit import Orbit
from tomo_polysplat.start.shadow import slices_seen
from tomo_polysplat.start.slabs import in_one_piece, rows_of, slab_of

if TYPE_CHECKING:
    from tomo_polysplat.start.whole_rows import WholeRows

__all__ = ["fdk_by_ranks"]

logger = logging.getLogger(__name__)

# Voxels times views below which a GPU is done in some 30 ms.
_WORTH = 1 << 33
# Rays that are sent at once.
_SENT = 1 << 26


# Gets (views, rows, columns) projections, of which some views are a tensor, their geometry, the grid, the orbit and the
# name of the filter.
_Make = Callable[["torch.Tensor | LevelRows", Geometry, VolumeGrid, Orbit, str], torch.Tensor]


class _Slab(NamedTuple):
    """Slices of a volume, the rows of the level detector that they need, and the geometry of these alone."""

    slices: slice
    rows: tuple[int, int]
    geometry: Geometry
    grid: VolumeGrid


# What makes a slab, and all of what.
def fdk_by_ranks(
    make: _Make,
    projections: torch.Tensor | np.ndarray | WholeRows,
    geometry: Geometry,
    grid: VolumeGrid,
    orbit: Orbit,
    filter_name: str,
) -> torch.Tensor | None:
    """`start.fdk.fdk`, shared out; None where that is not worth it, or where a device has no room for its part.

    Parameters
    ----------
    make : callable
        A function of a module that makes a slab of the rows which it needs, on any rank.
    projections : (views, rows, columns) float32 tensor or array, or WholeRows
        -log(I/I0), finite.
    geometry, grid, orbit
        Of a scan that filtered backprojection fits; on GPUs one that suits ASTRA's.
    filter_name : str
        See `fdk`.

    Returns
    -------
    (nz, ny, nx) tensor or None
        Where the projections are.

    Raises
    ------
    RankFailed
        If another rank fails.
    """
    ranks, slices = helpers(), grid.shape[0]
    if ranks.count == 1 or slices < ranks.count or math.prod(grid.shape) * geometry.views < _WORTH:
        return None
    if isinstance(projections, np.ndarray):
        projections = torch.from_numpy(np.require(projections, np.float32, ("C", "W")))
    values = projections.float() if isinstance(projections, torch.Tensor) else projections
    level = Level(geometry)
    if values.device.type != ranks.device.type or not in_one_piece(values, level, grid):
        return None
    parts = [part_of(slices, rank, ranks.count) for rank in range(ranks.count)]
    slabs = [_slab(level.geometry, grid, part) for part in parts]
    with ranks.together():
        whole = _made_together(ranks, make, values, level, grid, slabs, orbit, filter_name)
    if whole is not None:
        whole[torch.from_numpy(~slices_seen(geometry, grid, orbit)).to(whole.device)] = 0.0
    return whole


def _slab(geometry: Geometry, grid: VolumeGrid, part: slice) -> _Slab:
    own = slab_of(grid, part.start, part.stop)
    rows = rows_of(geometry, own)
    return _Slab(part, rows, geometry.cropped(rows, (0, geometry.columns)), own)


# All that is told, and what is sent of it.
def _made_together(
    ranks: Ranks,
    make: _Make,
    values: torch.Tensor | WholeRows,
    level: Level,
    grid: VolumeGrid,
    slabs: list[_Slab],
    orbit: Orbit,
    filter_name: str,
) -> torch.Tensor | None:
    """Rank 0's part, and the volume of all; None where a rank has no room."""
    ranks.tell("work", _follow, make, slabs, orbit, filter_name)
    whole = _empty(grid.shape, values.device)
    if any_lacks(ranks, whole is None):
        return None
    assert whole is not None
    pieces = [LevelRows(level, values, slab.rows, values.device) for slab in slabs]
    for rank, (piece, slab) in enumerate(zip(pieces[1:], slabs[1:]), 1):
        for some in _portions(slab.geometry):
            ranks.send([piece[some]], rank)
    own = _made(make, pieces[0], slabs[0], orbit, filter_name)
    if any_lacks(ranks, own is None):
        return None
    assert own is not None
    whole[slabs[0].slices] = own
    for rank, slab in enumerate(slabs[1:], 1):
        ranks.receive([whole[slab.slices]], rank)
    return whole


def _follow(ranks: Ranks, make: _Make, slabs: list[_Slab], orbit: Orbit, filter_name: str) -> None:
    """Another rank's part."""
    slab = slabs[ranks.rank]
    piece = _empty(slab.geometry.shape, ranks.device)
    if any_lacks(ranks, piece is None):
        return
    assert piece is not None
    for some in _portions(slab.geometry):
        ranks.receive([piece[some]])
    made = _made(make, piece, slab, orbit, filter_name)
    if not any_lacks(ranks, made is None):
        assert made is not None
        ranks.send([made])
    del piece, made
    if ranks.device.type == "cuda":
        # ASTRA cannot use what torch keeps, nor can what comes next of another size.
        give_back()


def _made(
    make: _Make, piece: torch.Tensor | LevelRows, slab: _Slab, orbit: Orbit, filter_name: str
) -> torch.Tensor | None:
    """The volume of a slab; None where there is no room for what that takes."""
    try:
        return make(piece, slab.geometry, slab.grid, orbit, filter_name)
    except RuntimeError as problem:
        logger.info("Filtered backprojection is not shared out: %s", problem)
        return None


def _empty(shape: tuple[int, ...], device: torch.device) -> torch.Tensor | None:
    try:
        return torch.empty(shape, dtype=torch.float32, device=device)
    except torch.cuda.OutOfMemoryError:
        return None


def _portions(geometry: Geometry) -> Iterator[slice]:
    """Views that are sent at once."""
    at_once = max(1, _SENT // (geometry.rows * geometry.columns))
    for first in range(0, geometry.views, at_once):
        yield slice(first, min(first + at_once, geometry.views))
