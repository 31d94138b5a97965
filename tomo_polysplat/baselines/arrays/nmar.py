"""NMAR: interpolation of the metal trace after dividing by the projections of a segmented prior."""

from __future__ import annotations

import numpy as np
import torch

from tomo_polysplat.baselines.arrays.fdk import fdk
from tomo_polysplat.baselines.arrays.metal_trace import MetalTrace, find_metal, forward_project, replace_trace
from tomo_polysplat.baselines.arrays.water_bhc import water_corrected
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.scan.defects import fill_invalid
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.settings import Settings
from tomo_polysplat.start.bridged import THIN, normalising_volume
from tomo_polysplat.start.levels import mass_level

__all__ = ["nmar"]


def nmar(
    projections: np.ndarray,
    geometry: Geometry,
    grid: VolumeGrid,
    spectrum: Spectrum | None = None,
    *,
    metal_level: float | None = None,
    device: str = "cpu",
) -> np.ndarray:
    """Normalised metal artefact reduction (Meyer et al. 2010, doi:10.1118/1.3484090).

    The prior is the interpolated reconstruction, with air and soft matter made uniform. Bone stays as it is.
    Parameters and result are those of :func:`tomo_polysplat.baselines.arrays.limar.limar`.
    """
    corrected = water_corrected(projections, spectrum)
    metal = find_metal(corrected, geometry, grid, level=metal_level, device=device)
    kept = np.isfinite(corrected) & ~metal.rays
    bridged = fill_invalid(corrected, kept)
    prior = forward_project(
        _prior(fdk(bridged, geometry, grid, filter_name="hann", device=device), metal),
        geometry,
        grid,
        device=device,
    )
    thick = prior > THIN * prior.max(initial=0.0)
    divisor = np.where(thick, prior, 1)
    normalised = fill_invalid(np.where(thick, corrected / divisor, 0).astype(np.float32), kept | ~thick)
    bridged = np.where(kept | ~thick, bridged, normalised * divisor)
    return replace_trace(fdk(bridged, geometry, grid, device=device), metal)


def _prior(volume: np.ndarray, metal: MetalTrace) -> np.ndarray:
    soft = mass_level(np.where(metal.mask, 0, volume))
    most = Settings().metal_level * soft
    return normalising_volume(torch.from_numpy(volume), torch.from_numpy(metal.mask), soft, most).numpy()
