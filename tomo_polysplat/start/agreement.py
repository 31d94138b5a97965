"""How much of what varies in a volume is the object's, told by two volumes of half the views each."""

from __future__ import annotations

import math

import numpy as np
import torch

from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.fdk import fdk, fits_fdk
from tomo_polysplat.start.initial import FEW_VIEWS, fill_invalid
from tomo_polysplat.start.on_gpu import fdk_on_gpu

__all__ = ["halves_agree"]

# Voxels times views beyond which a CPU would spend longer on the two volumes than on much else.
_MOST_ADDITIONS = 5e9


def halves_agree(
    projections: torch.Tensor, geometry: Geometry, grid: VolumeGrid, body: torch.Tensor
) -> float | None:
    """Mean over pairs of neighbouring voxels of whether two half scans see the same one as the denser.

    The halves are every other view. Noise is independent in them, and the streaks of too few views are opposite, so
    that of homogeneous matter the sign of a difference in one tells nothing of that in the other, or the contrary.
    Where the object has texture that the scan resolves, they agree. Structural biologists compare half maps so to tell
    resolution (Harauz and van Heel 1986).

    Parameters
    ----------
    projections : (views, rows, columns) tensor
        -log(I/I0); NaN where a ray is not to be used.
    geometry, grid : Geometry, VolumeGrid
    body : (nz, ny, nx) bool tensor
        Voxels of the object.

    Returns
    -------
    float or None
        1 where all agree, 0 by chance, -1 where none does; None where no two volumes can be made by filtered
        backprojection, or not in reasonable time.
    """
    if geometry.views < 2 * FEW_VIEWS or not bool(body.any()):
        return None
    halves = []
    for first in (0, 1):
        volume = _half(projections, geometry, grid, np.arange(first, geometry.views, 2))
        if volume is None:
            return None
        halves.append(volume.to(body.device))
    signs = count = 0.0
    for axis, length in enumerate(grid.shape):
        if length > 1:
            both = body.narrow(axis, 1, length - 1) & body.narrow(axis, 0, length - 1)
            one, other = (half.diff(dim=axis)[both].sign() for half in halves)
            signs, count = signs + float((one * other).sum(dtype=torch.float64)), count + len(one)
    return signs / count if count else None


def _half(
    projections: torch.Tensor, geometry: Geometry, grid: VolumeGrid, views: np.ndarray
) -> torch.Tensor | None:
    some = geometry.select(views)
    if not fits_fdk(some, grid)[0]:
        return None
    values = projections[torch.from_numpy(views).to(projections.device)]
    volume = fdk_on_gpu(values, some, grid) if values.is_cuda else None
    if volume is None and math.prod(grid.shape) * geometry.views <= _MOST_ADDITIONS:
        array = values.cpu().numpy()
        filled = fill_invalid(array, np.isfinite(array))
        volume = torch.from_numpy(fdk(filled, some, grid, filter_name="hann"))
    return volume
