"""Line integrals of one volume for many views, portion by portion, of which each rank makes a part."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
import torch

from tomo_polysplat.rank_work import any_lacks, helpers
from tomo_polysplat.ranks import Ranks, part_of
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.voxel_projector import ProjectorPair, projector_pair

__all__ = ["projected"]

logger = logging.getLogger(__name__)

# Steps along all rays below which a GPU is done in some 30 ms.
_WORTH = 1e10


def projected(
    volume: torch.Tensor,
    pair: ProjectorPair,
    geometry: Geometry,
    grid: VolumeGrid,
    portions: Iterable[np.ndarray],
) -> Iterator[tuple[np.ndarray, torch.Tensor]]:
    """Each portion of the views with its (views, rows, columns) line integrals.

    Parameters
    ----------
    volume : (nz, ny, nx) tensor
        Not changed before the end.
    pair : ProjectorPair
        Of this geometry and grid.
    geometry, grid : Geometry, VolumeGrid
    portions : iterable of int arrays
        Numbers of views.

    Raises
    ------
    RuntimeError
        If a device has no room for it; `RankFailed` if another rank fails.
    """
    ranks = helpers()
    alike = volume.device.type == ranks.device.type
    if ranks.count == 1 or not alike or math.prod(geometry.shape) * max(grid.shape) < _WORTH:
        for some in portions:
            yield some, pair.forward(volume, some)
        return
    number = ranks.number()
    with ranks.together():
        ranks.tell("work", _hold, number, volume, geometry, grid)
    try:
        for some in portions:
            parts = [some[part_of(len(some), rank, ranks.count)] for rank in range(ranks.count)]
            if len(some) < ranks.count:
                yield some, pair.forward(volume, some)
            else:
                shape = (len(some), geometry.rows, geometry.columns)
                yield some, _portion(ranks, number, volume, pair, parts, shape)
    finally:
        ranks.let_go(number)


# What is projected by what, and which part of it each rank makes.
def _portion(
    ranks: Ranks,
    number: int,
    volume: torch.Tensor,
    pair: ProjectorPair,
    views: list[np.ndarray],
    shape: tuple[int, int, int],
) -> torch.Tensor:
    """A portion of the views, put together of the parts that the ranks make."""
    # Before anybody is told: there may be no room for it.
    whole = torch.empty(shape, dtype=torch.float32, device=volume.device)
    parts = whole.split([len(part) for part in views])
    with ranks.together():
        ranks.tell("work", _follow, number, views)
        own = _lines(volume, pair, views[0])
        lack = any_lacks(ranks, own is None)
        if own is not None and not lack:
            parts[0].copy_(own)
            for rank, part in enumerate(parts[1:], 1):
                ranks.receive([part], rank)
            return whole
    raise RuntimeError("a device has no room to project its part of the views")


class _Held(NamedTuple):
    """What another rank keeps until rank 0 lets it go."""

    volume: torch.Tensor
    geometry: Geometry
    grid: VolumeGrid


def _hold(ranks: Ranks, number: int, *what: Any) -> None:
    ranks.lent[number] = _Held(*what)


def _follow(ranks: Ranks, number: int, views: list[np.ndarray]) -> None:
    """Another rank's part of a portion."""
    volume, geometry, grid = ranks.lent[number]
    with projector_pair(geometry, grid, ranks.device) as pair:
        lines = _lines(volume, pair, views[ranks.rank])
    if not any_lacks(ranks, lines is None):
        assert lines is not None
        ranks.send([lines])


def _lines(volume: torch.Tensor, pair: ProjectorPair, views: np.ndarray) -> torch.Tensor | None:
    try:
        return pair.forward(volume, views)
    except RuntimeError as problem:
        logger.info("A part of a projection has no room: %s", problem)
        return None
