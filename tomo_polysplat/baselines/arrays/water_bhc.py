"""Filtered backprojection after the common beam-hardening correction for water."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.baselines.arrays.fdk import fdk
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.water import water_linearised
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid

__all__ = ["water_bhc", "water_corrected"]


def water_bhc(
    projections: np.ndarray, geometry: Geometry, grid: VolumeGrid, spectrum: Spectrum, *, device: str = "cpu"
) -> np.ndarray:
    """Attenuation (nz, ny, nx) in 1/unit at the effective energy, right where the object is water.

    Parameters
    ----------
    projections : (views, rows, columns) float32
        ``-log(I / I0)``, NaN where not measured.
    geometry, grid : Geometry, VolumeGrid
    spectrum : Spectrum
        From which the correction follows (Herman 1979, doi:10.1088/0031-9155/24/1/008).
    device : {"cpu", "cuda", "cuda:N"}
    """
    return fdk(water_corrected(projections, spectrum), geometry, grid, device=device)


def water_corrected(projections: np.ndarray, spectrum: Spectrum | None) -> np.ndarray:
    """Projections corrected to those of a monochromatic scan of water; unchanged without a spectrum."""
    return projections if spectrum is None else water_linearised(projections, spectrum).astype(np.float32)
