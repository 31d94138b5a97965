"""A volume of Gaussians on the host, of which each rank makes some slices.

Rank 0 has all Gaussians, and sends them to the others, 56 bytes each. What they make comes through its device.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import torch

from tomo_polysplat.rank_work import any_lacks, helpers
from tomo_polysplat.ranks import Ranks, part_of
from tomo_polysplat.transfer import to_host

__all__ = ["volume_by_ranks"]

logger = logging.getLogger(__name__)

# Voxels below which a GPU is done in a tenth of a second.
_WORTH = 1 << 24


def volume_by_ranks(
    make: Callable[[int, int], torch.Tensor],
    channels: int,
    shape: tuple[int, int, int],
    device: torch.device,
    halo: int,
    most: int,
) -> np.ndarray | None:
    """As `fit.slabs.on_host`; None where one rank makes it all, which it does as well where one has no room.

    ``make`` is sent to the others, with the tensors that it holds; ``most`` is what rank 0 has room for.
    """
    ranks, (nz, ny, nx) = helpers(), shape
    alike = device.type == ranks.device.type
    if ranks.count == 1 or nz < ranks.count or not alike or nz * ny * nx < _WORTH:
        return None
    depth = min(max(1, most // (ny * nx)), -(-nz // ranks.count))
    buffer = _room((channels, depth, ny, nx), device)
    if buffer is None:
        return None
    whole = np.empty((channels, *shape), np.float32)
    with ranks.together(), torch.no_grad():
        ranks.tell("work", _follow, make, channels, shape, halo, depth)
        for slabs in _rounds(nz, depth, halo, ranks.count):
            own = _made(make, slabs[0])
            if any_lacks(ranks, own is None):
                return None
            assert own is not None
            _keep(own, slabs[0], whole)
            del own
            for rank, slab in enumerate(slabs[1:], 1):
                theirs = buffer.view(-1)[: channels * slab.slices * ny * nx]
                theirs = theirs.view(channels, slab.slices, ny, nx)
                ranks.receive([theirs], rank)
                _keep(theirs, slab, whole)
    return whole


@torch.no_grad()
def _follow(
    ranks: Ranks,
    make: Callable[[int, int], torch.Tensor],
    channels: int,
    shape: tuple[int, int, int],
    halo: int,
    depth: int,
) -> None:
    """Another rank's slabs."""
    for slabs in _rounds(shape[0], depth, halo, ranks.count):
        made = _made(make, slabs[ranks.rank])
        if any_lacks(ranks, made is None):
            return
        assert made is not None
        ranks.send([made])
        # There may be no room for two.
        del made


class _Slab(NamedTuple):
    """Slices that are wanted, and the first and the one behind the last that are made, with the halo."""

    wanted: slice
    first: int
    last: int

    @property
    def slices(self) -> int:
        """How many are wanted, maybe none."""
        return self.wanted.stop - self.wanted.start


def _rounds(slices: int, depth: int, halo: int, count: int) -> Iterator[list[_Slab]]:
    """A slab of each rank, until all slices are made: the last ones may be empty."""
    parts = [part_of(slices, rank, count) for rank in range(count)]
    for done in range(0, max(part.stop - part.start for part in parts), depth):
        starts = [min(part.start + done, part.stop) for part in parts]
        now = [slice(start, min(start + depth, part.stop)) for start, part in zip(starts, parts)]
        yield [_Slab(one, max(one.start - halo, 0), min(one.stop + halo, slices)) for one in now]


def _made(make: Callable[[int, int], torch.Tensor], slab: _Slab) -> torch.Tensor | None:
    """(channels, slices, ny, nx) of a slab, nothing of an empty one; None where there is no room for it."""
    if not slab.slices:
        return torch.empty(0)
    try:
        made = make(slab.first, slab.last)
    except torch.cuda.OutOfMemoryError as problem:
        logger.info("The volume is not shared out: %s", problem)
        return None
    return made[:, slab.wanted.start - slab.first : slab.wanted.stop - slab.first]


def _room(shape: tuple[int, ...], device: torch.device) -> torch.Tensor | None:
    try:
        return torch.empty(shape, dtype=torch.float32, device=device)
    except torch.cuda.OutOfMemoryError:
        return None


def _keep(made: torch.Tensor, slab: _Slab, whole: np.ndarray) -> None:
    for values, channel in zip(made, whole):
        to_host(values, channel[slab.wanted])
