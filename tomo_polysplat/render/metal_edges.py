"""Metal has a surface: the tails that its Gaussians cast over the neighbouring voxels are put back inside it."""

from __future__ import annotations

from collections.abc import Callable

import torch

__all__ = ["tail_factors"]

# Metal below this share of what else a voxel holds leaves it clean enough to tell what lies beside the metal.
_CLEAN = 0.02


def tail_factors(metal: torch.Tensor, rest: torch.Tensor, share: float) -> torch.Tensor:
    """What to multiply each voxel's metal by, so that faint rims move into the voxels they belong to.

    A voxel that holds less than ``share`` of the largest metal among itself and its neighbours holds the tail of
    a Gaussian, not metal; what it holds goes to those neighbours that are metal, in proportion to what they
    hold. One percent of iron is as bright as water, so such tails would dominate the error of what surrounds
    metal. Where the fit has lowered the rest of a voxel to make room for a tail, as much of the tail stays as
    brings the voxel to the level of clean voxels nearby: the rays see only the sum.

    Parameters
    ----------
    metal, rest : (nz, ny, nx) tensor
        Attenuation of the metal alone, and of all else.
    share : float
        0 leaves everything as it is.

    Returns
    -------
    (nz, ny, nx) tensor
        The attenuation of the metal, summed over all voxels, is kept.
    """
    if share <= 0 or not bool((metal > 0).any()):
        return torch.ones_like(metal)
    tail = metal < share * _pooled(metal, 1, torch.nn.functional.max_pool3d)
    owner = _around(metal.masked_fill(tail, 0.0), 1)
    # A tail without metal beside it has nowhere to go and stays.
    tail &= owner > 0
    clean = (metal <= _CLEAN * rest).to(metal.dtype)
    known = _around(clean, 2)
    level = torch.where(known > 0, _around(rest * clean, 2) / known.clamp(min=1), rest)
    tiny = torch.finfo(metal.dtype).tiny
    kept = torch.where(tail, ((level - rest) / metal.clamp(min=tiny)).clamp(0.0, 1.0), torch.ones_like(metal))
    given = metal * (1 - kept) / owner.clamp(min=tiny)
    return torch.where(tail, kept, 1 + _around(given, 1))


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
