"""Gaussians sampled at voxel centres in plain torch: any device, any float type, differentiable; the truth."""

from __future__ import annotations

from typing import Any

import torch

from tomo_polysplat.kernels.project.reference import whitening_matrices
from tomo_polysplat.kernels.voxelise.box import VoxelBox

__all__ = ["voxelise"]

_PAIRS_AT_ONCE = 1 << 22


def voxelise(
    position: torch.Tensor,
    scale: torch.Tensor,
    rotation: torch.Tensor,
    weight: torch.Tensor,
    box: VoxelBox,
    cutoff: float,
) -> torch.Tensor:
    """``sum_n weight_kn exp(-|W_n (x - p_n)|^2 / 2)`` at the voxel centres, cut at ``cutoff`` deviations.

    Parameters as for ``kernels.project.reference.project``. Returns a (channels, nz, ny, nx) tensor.
    """
    like: dict[str, Any] = {"device": position.device, "dtype": position.dtype}
    axes = [box.first[k] + torch.arange(box.shape[2 - k], **like) * box.spacing[k] for k in range(3)]
    z, y, x = torch.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    centres = torch.stack([x, y, z], -1).reshape(-1, 3)
    whiten = whitening_matrices(scale, rotation)
    volume = torch.zeros((len(weight), len(centres)), **like)
    chunk = max(1, _PAIRS_AT_ONCE // max(1, len(centres)))
    for start in range(0, max(1, len(position)), chunk):
        part = slice(start, start + chunk)
        offset = centres[None] - position[part, None]
        squared = torch.einsum("nab,nvb->nva", whiten[part], offset).square().sum(-1)
        value = torch.where(squared <= cutoff**2, torch.exp(-0.5 * squared), torch.zeros_like(squared))
        volume = volume + weight[:, part] @ value
    return volume.reshape(len(weight), *box.shape)
