"""Gaussians that hold nothing are put where the rays ask for more detail."""

from __future__ import annotations

import math

import torch

from tomo_polysplat.model.gaussians import Gaussians

__all__ = ["relocate"]

# Attenuation, in soft references, below which a Gaussian holds nothing.
_DEAD = 1e-3


@torch.no_grad()
def relocate(gaussians: Gaussians, pull: torch.Tensor, share: float) -> torch.Tensor:
    """Split the Gaussians that are pulled hardest, into the places of those that hold nothing.

    A Gaussian that is pulled both ways at once covers something finer than itself. It becomes two along its
    longest axis, half a deviation to either side, 0.7 times as long; their mass together is the old one's.

    Parameters
    ----------
    gaussians : Gaussians
        Changed in place.
    pull : (n,) tensor
        How hard the rays have pulled at each position: lengths of the loss's gradients, added up.
    share : float
        At most this share of the Gaussians moves.

    Returns
    -------
    (m,) int64 tensor
        Indices of all that changed, whose optimiser's memory is void.
    """
    dead = (gaussians.attenuation < _DEAD) & (gaussians.group <= 0)
    alive = gaussians.attenuation >= _DEAD
    count = min(int(dead.sum()), int(alive.sum()), int(share * len(gaussians)))
    if count == 0:
        return dead.new_zeros(0, dtype=torch.int64)
    target = dead.nonzero()[:count, 0]
    source = torch.where(alive, pull, -torch.ones_like(pull)).topk(count).indices
    axis = gaussians.log_scale[source].argmax(dim=1)
    half = 0.5 * gaussians.log_scale[source, axis].exp()[:, None] * _axis(gaussians.rotation[source], axis)
    gaussians.log_scale[source, axis] += math.log(0.7)
    gaussians.attenuation[source] *= 0.5 / 0.7
    for tensor in gaussians.each().values():
        tensor[target] = tensor[source]
    gaussians.position[source] -= half
    gaussians.position[target] += half
    return torch.cat([source, target])


def _axis(rotation: torch.Tensor, axis: torch.Tensor) -> torch.Tensor:
    """(m, 3) directions of the chosen axes: columns of the rotation matrices of quaternions (w, x, y, z)."""
    w, x, y, z = torch.nn.functional.normalize(rotation, dim=1).unbind(1)
    columns = torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1),
            torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], 1),
            torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1),
        ],
        1,
    )
    return columns[torch.arange(len(axis), device=axis.device), axis]
