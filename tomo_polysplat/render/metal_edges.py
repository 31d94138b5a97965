"""Metal has a surface: the tails that its Gaussians cast over the neighbouring voxels are put back inside it."""

from __future__ import annotations

import torch

__all__ = ["without_tails"]


def without_tails(metal: torch.Tensor, share: float) -> torch.Tensor:
    """Move a volume's faint rims into the voxels they belong to.

    A voxel that holds less than ``share`` of the largest value among itself and its neighbours is the tail of a
    Gaussian, not metal; what it holds goes to those neighbours that are metal, in proportion to what they hold.
    One percent of iron is as bright as water, so such tails would dominate the error of what surrounds metal.

    Parameters
    ----------
    metal : (channels, nz, ny, nx) tensor
        Densities of the metal alone. The sum over all voxels is kept, channel by channel to first order.
    share : float
        0 leaves everything as it is.

    Returns
    -------
    (channels, nz, ny, nx) tensor
    """
    total = metal.sum(dim=0, keepdim=True)
    if share <= 0 or not bool((total > 0).any()):
        return metal
    window = tuple(3 if n > 1 else 1 for n in total.shape[1:])
    # Padded beforehand: the pools themselves refuse an axis of two voxels.
    margin = [n // 2 for n in reversed(window) for _ in range(2)]

    def around(volume: torch.Tensor) -> torch.Tensor:
        """Sums over the neighbourhood."""
        count = window[0] * window[1] * window[2]
        return count * torch.nn.functional.avg_pool3d(
            torch.nn.functional.pad(volume, margin), window, stride=1
        )

    peak = torch.nn.functional.max_pool3d(torch.nn.functional.pad(total, margin), window, stride=1)
    tail = total < share * peak
    body = total.masked_fill(tail, 0.0)
    owner = around(body)
    # A tail without metal beside it has nowhere to go and stays.
    tail &= owner > 0
    given = torch.where(tail, total / owner.clamp(min=torch.finfo(total.dtype).tiny), torch.zeros_like(total))
    return torch.where(tail, torch.zeros_like(metal), metal * (1 + around(given)))
