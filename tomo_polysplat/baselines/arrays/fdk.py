"""Filtered backprojection as it is commonly run: sharp filter, nothing corrected, nothing clipped."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.scan.defects import fill_invalid
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start import fdk as start

__all__ = ["fdk"]


def fdk(
    projections: np.ndarray,
    geometry: Geometry,
    grid: VolumeGrid,
    *,
    filter_name: str = "ram-lak",
    device: str = "cpu",
) -> np.ndarray:
    """Feldkamp, Davis and Kress (1984, doi:10.1364/JOSAA.1.000612); ASTRA's backprojection on a GPU.

    Parameters
    ----------
    projections : (views, rows, columns) float32
        ``-log(I / I0)``; NaN is interpolated along its detector row.
    geometry, grid : Geometry, VolumeGrid
        A scan that filtered backprojection fits.
    filter_name : str
        See :func:`tomo_polysplat.start.fdk.fdk`.
    device : {"cpu", "cuda", "cuda:N"}

    Returns
    -------
    (nz, ny, nx) float32
        Attenuation in 1/unit, not clipped.

    Raises
    ------
    ValueError
        If the scan does not fit; the message says why.
    """
    filled = fill_invalid(projections, np.isfinite(projections))
    return start.fdk(filled, geometry, grid, filter_name=filter_name, device=device)
