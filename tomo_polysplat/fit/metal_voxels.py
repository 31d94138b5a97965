"""How dense metal is where its Gaussians are."""

from __future__ import annotations

import torch

from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians

__all__ = ["levels_of_pieces", "metal_voxels"]


def metal_voxels(metal: Gaussians, scene: FitScene) -> tuple[torch.Tensor, torch.Tensor]:
    """The part of the volume that metal is in, with the voxels that touch it.

    Parameters
    ----------
    metal : Gaussians
        n of them, all of metal. What else lies there is not counted.
    scene : FitScene

    Returns
    -------
    values : (nz, ny, nx) tensor
        Attenuation in soft references.
    index : (n, 3) int64 tensor
        Indices (z, y, x) of the voxel that each Gaussian is in, or of the nearest one.
    """
    index = scene.box.voxels_of(metal.position)
    lowest = (index.amin(dim=0) - 1).clamp(min=0)
    highest = torch.minimum(index.amax(dim=0) + 1, index.new_tensor(scene.box.shape) - 1)
    z, y, x = lowest.tolist()
    nz, ny, nx = (highest - lowest + 1).tolist()
    return scene.attenuation(metal, scene.box.part((z, y, x), (nz, ny, nx))), index - lowest


def levels_of_pieces(
    metal: Gaussians, values: torch.Tensor, index: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The pieces of metal, and how dense each is, from what `metal_voxels` gave.

    The level of a piece is the median of its Gaussians' voxels: the outermost ones hold something else as well.

    Parameters
    ----------
    metal : Gaussians
        n of them.
    values : (nz, ny, nx) tensor
    index : (n, 3) int64 tensor

    Returns
    -------
    pieces : (m,) int64 tensor
    levels : (m,) tensor
    of_each : (n,) int64 tensor
        The place of each Gaussian's piece among the pieces.
    """
    own = values[tuple(index.T)]
    pieces, of_each, many = metal.group.unique(return_inverse=True, return_counts=True)
    ranked = own.argsort()
    ranked = ranked[of_each[ranked].argsort(stable=True)]
    first = many.cumsum(0) - many
    lower, upper = (own[ranked[first + half]] for half in ((many - 1) // 2, many // 2))
    return pieces, (lower + upper) / 2, of_each
