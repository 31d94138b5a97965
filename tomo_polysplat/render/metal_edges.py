"""Metal has a surface: the tails that its Gaussians cast over the neighbouring voxels are put back inside it."""

from __future__ import annotations

from collections.abc import Callable

import torch

from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.render.renderer import voxelise_peaks

__all__ = ["tail_factors", "tails"]

# Voxels about one whose largest metal is the level of the metal there: the next ones may all be at its surface.
_AROUND = 2
# Shares of the level below which a voxel's metal is all tail, and from which on it is none. Voxels at a surface are
# seldom far from the level: where all or nothing hung on it, single ones changed sides from one pass to the next, and a
# slice of 64^2 with them by 2.8 dB.
_ALL, _NONE = 0.9, 1.2
# Metal below this share of what else a voxel holds leaves it clean enough to tell what lies beside the metal.
_CLEAN = 0.02


def tails(
    metal: torch.Tensor,
    gaussians: Gaussians,
    weights: torch.Tensor,
    box: VoxelBox,
    kernel: str,
    level: float,
) -> torch.Tensor:
    """How much of the metal of every voxel is the tails of Gaussians that lie in others.

    The surface of a solid that is seen a little blurred lies where half of what it holds is reached; a voxel no
    point of which comes near to ``level`` times the metal around it lies outside.

    Parameters
    ----------
    metal : (nz, ny, nx) tensor
        Attenuation of the metal, means over the voxels of ``box``.
    gaussians, weights, kernel
        The metal's Gaussians and their (1, n) attenuation; see ``render.renderer``.
    level : float
        0: none.

    Returns
    -------
    (nz, ny, nx) tensor
        From 0 to 1.
    """
    share = torch.zeros_like(metal)
    if not (level and len(gaussians)):
        return share
    needed = level * _pooled(metal, _AROUND, torch.nn.functional.max_pool3d)
    where = ((metal > 0) & (metal < _NONE * needed)).nonzero()
    if not len(where):
        return share
    low, end = where.amin(dim=0).tolist(), (where.amax(dim=0) + 1).tolist()
    z, y, x = (slice(*ends) for ends in zip(low, end))
    shape = tuple(b - a for a, b in zip(low, end))
    peaks = voxelise_peaks(gaussians, weights, box.part(tuple(low), shape), kernel)[0]
    reached = torch.maximum(peaks, metal[z, y, x]) / needed[z, y, x].clamp(min=torch.finfo(metal.dtype).tiny)
    share[z, y, x] = ((_NONE - reached) / (_NONE - _ALL)).clamp(0.0, 1.0)
    return share.masked_fill(metal <= 0, 0.0)


def tail_factors(metal: torch.Tensor, rest: torch.Tensor, tail: torch.Tensor) -> torch.Tensor:
    """What to multiply each voxel's metal by, so that faint rims move into the voxels they belong to.

    What is tail goes to the metal that is none in the voxel itself and beside it, in proportion to that. One percent of
    iron is as bright as water, so such tails would dominate the error of what surrounds metal. Where the fit has
    lowered the rest of a voxel to make room for a tail, as much of the tail stays as brings the voxel to the level
    of clean voxels nearby: the rays see only the sum.

    Parameters
    ----------
    metal, rest : (nz, ny, nx) tensor
        Attenuation of the metal alone, and of all else.
    tail : (nz, ny, nx) tensor
        How much of the metal is tails; see `tails`.

    Returns
    -------
    (nz, ny, nx) tensor
        The attenuation of the metal, summed over all voxels, is kept.
    """
    if not bool(tail.any()):
        return torch.ones_like(metal)
    owned = 1 - tail
    owner = _around(metal * owned, 1)
    # A tail without metal beside it that could own it has nowhere to go and stays.
    tail = torch.where(owner >= metal * tail, tail, 0.0)
    clean = (metal <= _CLEAN * rest).to(metal.dtype)
    known = _around(clean, 2)
    level = torch.where(known > 0, _around(rest * clean, 2) / known.clamp(min=1), rest)
    tiny = torch.finfo(metal.dtype).tiny
    leaving = tail * (1 - ((level - rest) / metal.clamp(min=tiny)).clamp(0.0, 1.0))
    given = metal * leaving / owner.clamp(min=tiny)
    return 1 - leaving + owned * _around(given, 1)


def _around(volume: torch.Tensor, reach: int) -> torch.Tensor:
    """Sums over the neighbourhood of every voxel, itself included."""
    cells = (2 * reach + 1) ** sum(n > 1 for n in volume.shape)
    return cells * _pooled(volume, reach, torch.nn.functional.avg_pool3d)


def _pooled(volume: torch.Tensor, reach: int, pool: Callable[..., torch.Tensor]) -> torch.Tensor:
    """A pool over ``reach`` voxels each way; beyond the border lies nothing."""
    window = tuple(2 * reach + 1 if n > 1 else 1 for n in volume.shape)
    # Padded beforehand: the pools themselves refuse an axis of fewer voxels than the window.
    margin = [n // 2 for n in reversed(window) for _ in range(2)]
    return pool(torch.nn.functional.pad(volume, margin)[None], window, stride=1)[0]
