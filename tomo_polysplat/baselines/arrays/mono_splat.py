"""Gaussians without a spectrum: one energy for all, as in R2-Gaussian (arXiv:2405.20693)."""

from __future__ import annotations

from typing import Any

import numpy as np

from tomo_polysplat.reconstruction import reconstruct
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid, to_astra

__all__ = ["mono_splat"]


def mono_splat(
    projections: np.ndarray, geometry: Geometry, grid: VolumeGrid, *, device: str = "cpu", **options: Any
) -> Result:
    """Our own solver with one channel instead of three, so that only the physics differs.

    Parameters
    ----------
    projections : (views, rows, columns) float32
        ``-log(I / I0)``, NaN where not measured.
    geometry, grid : Geometry, VolumeGrid
    device : {"cpu", "cuda", "cuda:N"}
    options
        Others of :func:`tomo_polysplat.reconstruct`, such as ``time_budget``, ``seed`` or ``callbacks``.

    Returns
    -------
    Result
        Its ``volume`` (nz, ny, nx) is in 1/unit.
    """
    proj_geom, vol_geom = to_astra(geometry, grid)
    ordered = np.ascontiguousarray(projections.swapaxes(0, 1))
    return reconstruct(ordered, proj_geom, vol_geom, spectrum=None, device=device, **options)
