"""Filtered backprojection of projections that are on a GPU, where they stay."""

from __future__ import annotations

import torch

from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.orbit import find_orbit
from tomo_polysplat.start.whole_rows import WholeRows

__all__ = ["fdk_on_gpu"]


def fdk_on_gpu(
    projections: WholeRows, geometry: Geometry, grid: VolumeGrid, device: torch.device | None = None
) -> torch.Tensor | None:
    """Smooth filtered backprojection (nz, ny, nx), or None where that takes the CPU.

    Parameters
    ----------
    projections : WholeRows
        -log(I/I0) of a scan that `fits_fdk`.
    geometry, grid : Geometry, VolumeGrid
        That of the rows as they are continued.
    device : torch.device, optional
        The GPU; that of the projections by default.

    Raises
    ------
    RuntimeError
        If the GPU has no room for it, by slabs either; with bytes needed and bytes free. `RankFailed` if another rank
        fails.
    """
    from tomo_polysplat.start.astra_fdk import fdk_cuda_tensor, suits_fdk_cuda
    from tomo_polysplat.start.fdk_by_ranks import fdk_by_ranks
    from tomo_polysplat.start.slabs import fdk_on_device

    orbit, _ = find_orbit(geometry)
    if orbit is None or not suits_fdk_cuda(geometry)[0]:
        return None
    device = projections.device if device is None else device
    # Smooth: the noise of a sharp filter would be seeded as if it were matter.
    shared = fdk_by_ranks(fdk_cuda_tensor, projections, geometry, grid, orbit, "hann")
    return fdk_on_device(projections, geometry, grid, orbit, "hann", device) if shared is None else shared
