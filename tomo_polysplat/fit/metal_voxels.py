"""How dense metal is where its Gaussians are."""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage

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
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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
    pieces : (m,) int array
    levels : (m,) float array
    of_each : (n,) int array
        The place of each Gaussian's piece among the pieces.
    """
    own = values[tuple(index.T)].cpu().numpy()
    pieces, of_each = np.unique(metal.group.cpu().numpy(), return_inverse=True)
    return pieces, ndimage.median(own, of_each, range(len(pieces))), of_each
