"""Move the tails of metal Gaussians from neighbouring voxels back into the metal, which has a sharp surface."""

from __future__ import annotations

from collections.abc import Callable

import torch

from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.render.renderer import voxelise_means, voxelise_peaks

__all__ = ["HALO", "tail_factors", "tails"]

# The level of metal near a voxel is the largest metal within this many voxels: the next ones may all be at a surface.
_AROUND = 2
# Below the first share of the level a voxel's metal is all tail, from the second on none. Voxels at a surface are near
# the level: with one share single voxels changed sides from pass to pass, which cost a slice of 64^2 2.8 dB.
_ALL, _NONE = 0.9, 1.2
# A tail falls off from voxel to voxel, and a lighter metal beside the dense one does not. The least over the largest
# metal in a cube of two voxels an axis: up to the first it is a tail, from the second on it may be none.
_FALLS, _EVEN = 0.3, 0.5
# A voxel with less metal than this share of its other matter is clean: it shows what lies beside the metal.
_CLEAN = 0.02
# Voxels to every side on which a voxel's factor depends: metal around metal that owns tails, next to it.
HALO = _AROUND + 3


def tails(
    metal: torch.Tensor,
    gaussians: Gaussians,
    weights: torch.Tensor,
    box: VoxelBox,
    kernel: str,
    level: float,
) -> torch.Tensor:
    """The share of the metal in every voxel that is tails of Gaussians in other voxels.

    In a slightly blurred image the surface of a solid is where half of its attenuation is reached. So a voxel is
    outside if none of its points comes near to ``level`` times the metal around it. Where neighbours hold as much as it
    does, it may be a lighter metal. That is made of weaker Gaussians, and what lies between two pieces of one is not.

    Parameters
    ----------
    metal : (nz, ny, nx) tensor
        Attenuation of the metal, means over the voxels of ``box``.
    gaussians, weights, kernel
        The metal's Gaussians and their (1, n) attenuation; see ``render.renderer``.
    level : float
        Share of the metal around a voxel that its points must reach; 0 for no tails.

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
    tiny = torch.finfo(metal.dtype).tiny
    reached = torch.maximum(peaks, metal[z, y, x]) / needed[z, y, x].clamp(min=tiny)
    found = _outside(reached)
    even = ((_evenness(metal)[z, y, x] - _FALLS) / (_EVEN - _FALLS)).clamp(0.0, 1.0)
    if bool((found * even).any()):
        strength = _strength(metal, gaussians, weights, box, kernel)[z, y, x]
        found = found + even * (_outside(reached / strength.clamp(min=tiny)) - found)
    share[z, y, x] = found
    return share.masked_fill(metal <= 0, 0.0)


def _outside(reached: torch.Tensor) -> torch.Tensor:
    """The share that is tails, by the largest metal in voxels over that of a surface."""
    return ((_NONE - reached) / (_NONE - _ALL)).clamp(0.0, 1.0)


def _evenness(metal: torch.Tensor) -> torch.Tensor:
    """The least over the largest metal in the most even cube of two voxels an axis that a voxel is part of."""
    window = tuple(2 if n > 1 else 1 for n in metal.shape)
    margin = [n - 1 for n in reversed(window) for _ in range(2)]
    pool = torch.nn.functional.max_pool3d
    padded = torch.nn.functional.pad(metal, margin)[None]
    largest, least = pool(padded, window, stride=1), -pool(-padded, window, stride=1)
    return pool(least / largest.clamp(min=torch.finfo(metal.dtype).tiny), window, stride=1)[0]


def _strength(
    metal: torch.Tensor, gaussians: Gaussians, weights: torch.Tensor, box: VoxelBox, kernel: str
) -> torch.Tensor:
    """Attenuation at the centres of the Gaussians that a voxel's metal is of, over that where there is most metal."""
    own = voxelise_means(gaussians, weights * weights, box, kernel)[0]
    own = own / metal.clamp(min=torch.finfo(metal.dtype).tiny)
    window = [2 * _AROUND + 1 if n > 1 else 1 for n in metal.shape]
    margin = [n // 2 for n in window]
    _, most = torch.nn.functional.max_pool3d(metal[None], window, 1, margin, return_indices=True)
    densest = own.reshape(-1)[most[0]]
    return (own / densest.clamp(min=torch.finfo(metal.dtype).tiny)).clamp(max=1.0)


def tail_factors(metal: torch.Tensor, rest: torch.Tensor, tail: torch.Tensor) -> torch.Tensor:
    """Factors of the metal of each voxel, by which tails move into the metal they belong to.

    A tail goes to the metal that is no tail, in the voxel itself and beside it, in proportion to that metal. One per
    cent of iron is as bright as water, so tails would dominate the error around metal. The fit may have lowered the
    rest of a voxel to make room for a tail, because rays see only the sum. Then so much of the tail stays that the
    voxel comes to the level of clean voxels nearby.

    Parameters
    ----------
    metal, rest : (nz, ny, nx) tensor
        Attenuation of the metal alone, and of all else.
    tail : (nz, ny, nx) tensor
        Share of the metal that is tails; see `tails`.

    Returns
    -------
    (nz, ny, nx) tensor
        They keep the sum of the metal over all voxels.
    """
    if not bool(tail.any()):
        return torch.ones_like(metal)
    owned = 1 - tail
    owner = _around(metal * owned, 1)
    # A tail without metal beside it stays.
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
    """A pool over ``reach`` voxels each way; beyond the border everything is 0."""
    window = tuple(2 * reach + 1 if n > 1 else 1 for n in volume.shape)
    # Padded beforehand: the pools themselves refuse an axis of fewer voxels than the window.
    margin = [n // 2 for n in reversed(window) for _ in range(2)]
    return pool(torch.nn.functional.pad(volume, margin)[None], window, stride=1)[0]
