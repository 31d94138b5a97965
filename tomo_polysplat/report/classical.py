"""What the standard method makes of the same scan, to stand beside a result."""

from __future__ import annotations

import numpy as np
import torch

from tomo_polysplat.scan.defects import fill_invalid
from tomo_polysplat.scan.geometry import from_astra, projections_from_astra
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.start.fdk import fdk, fits_fdk
from tomo_polysplat.start.initial import initial_volume

__all__ = ["standard_volume"]


def standard_volume(scan: Scan, *, device: str = "auto") -> tuple[str, np.ndarray]:
    """Name and volume (z, y, x) in 1/unit: FDK with a sharp filter, nothing corrected; SIRT where FDK does not fit.

    Parameters
    ----------
    scan : Scan
    device : {"auto", "cpu", "cuda", "cuda:N"}
    """
    usable = scan.projections if scan.valid is None else np.where(scan.valid, scan.projections, np.nan)
    projections = projections_from_astra(usable, scan.proj_geom)
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if fits_fdk(geometry, grid)[0]:
        filled = fill_invalid(projections, np.isfinite(projections))
        return "FDK", fdk(filled, geometry, grid, device=device)
    volume, how = initial_volume(projections, geometry, grid, device=device)
    return str(how["method"]).upper(), volume
