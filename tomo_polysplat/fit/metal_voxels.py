"""How dense metal is where its Gaussians are."""

from __future__ import annotations

import itertools

import numpy as np
import torch
from scipy import ndimage

from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians

__all__ = ["levels_of_pieces", "metal_around"]


def metal_around(metal: Gaussians, scene: FitScene) -> tuple[np.ndarray, np.ndarray]:
    """Attenuation of metal in the voxel that each of its Gaussians is in, or in the nearest one, and beside that voxel.

    Parameters
    ----------
    metal : Gaussians
        n of them, all of metal. What else lies there is not counted.
    scene : FitScene

    Returns
    -------
    own : (n,) float array
        In soft references.
    least : (n,) float array
        The least of this voxel and of all that touch it, likewise.
    """
    index = scene.box.voxels_of(metal.position)
    last = index.new_tensor(scene.box.shape) - 1
    lowest, highest = (index.amin(dim=0) - 1).clamp(min=0), torch.minimum(index.amax(dim=0) + 1, last)
    z, y, x = lowest.tolist()
    nz, ny, nx = (highest - lowest + 1).tolist()
    values = scene.attenuation(metal, scene.box.part((z, y, x), (nz, ny, nx)))
    own = values[tuple((index - lowest).T)]
    least = own
    for step in itertools.product((-1, 0, 1), repeat=3):
        # At a face of the volume metal is taken to go on.
        beside = torch.minimum((index + index.new_tensor(step)).clamp(min=0), last)
        least = torch.minimum(least, values[tuple((beside - lowest).T)])
    return own.cpu().numpy(), least.cpu().numpy()


def levels_of_pieces(values: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pieces of metal, and the level of each: the median, as the outermost Gaussians' voxels hold other matter too.

    Parameters
    ----------
    values : (n,) float array
        What the voxels of the metal's Gaussians hold.
    group : (n,) int array
        The piece that each belongs to.

    Returns
    -------
    pieces : (m,) int array
    levels : (m,) float array
    """
    pieces = np.unique(group)
    return pieces, ndimage.median(values, group, pieces)
