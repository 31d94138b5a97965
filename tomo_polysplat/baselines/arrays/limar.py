"""LIMAR: rays through metal are replaced by interpolating between their neighbours."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.baselines.arrays.fdk import fdk
from tomo_polysplat.baselines.arrays.metal_trace import find_metal, replace_trace
from tomo_polysplat.baselines.arrays.water_bhc import water_corrected
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.scan.defects import fill_invalid
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid

__all__ = ["limar"]


def limar(
    projections: np.ndarray,
    geometry: Geometry,
    grid: VolumeGrid,
    spectrum: Spectrum | None = None,
    *,
    metal_level: float | None = None,
    device: str = "cpu",
) -> np.ndarray:
    """Linear interpolation of the metal trace (Kalender et al. 1987, doi:10.1148/radiology.164.2.3602406).

    Parameters
    ----------
    projections : (views, rows, columns) float32
        ``-log(I / I0)``, NaN where not measured.
    geometry, grid : Geometry, VolumeGrid
        A scan that filtered backprojection fits.
    spectrum : Spectrum, optional
        Corrects the projections for water first.
    metal_level : float, optional
        Threshold of metal in multiples of the main matter; see `find_metal`.
    device : {"cpu", "cuda", "cuda:N"}

    Returns
    -------
    (nz, ny, nx) float32
        Attenuation in 1/unit; metal as the first reconstruction showed it.
    """
    corrected = water_corrected(projections, spectrum)
    metal = find_metal(corrected, geometry, grid, level=metal_level, device=device)
    bridged = fill_invalid(corrected, np.isfinite(corrected) & ~metal.rays)
    return replace_trace(fdk(bridged, geometry, grid, device=device), metal)
