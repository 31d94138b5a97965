"""Filtered backprojection of projections that are on a GPU, where they stay."""

from __future__ import annotations

import torch

from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.orbit import find_orbit

__all__ = ["fdk_on_gpu", "fill_rows"]

# Pixels filled at once, on a device: the intermediate results are a dozen times as large.
_AT_ONCE = {"cuda": 1 << 24, "cpu": 1 << 20}


def fdk_on_gpu(
    projections: torch.Tensor,
    geometry: Geometry,
    grid: VolumeGrid,
    device: torch.device | None = None,
) -> torch.Tensor | None:
    """Smooth filtered backprojection (nz, ny, nx), or None where that takes the CPU.

    Parameters
    ----------
    projections : (views, rows, columns) float32 tensor
        -log(I/I0) of a scan that `fits_fdk`; pixels that are not finite are interpolated from their row.
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
    # Smooth: the noise of a sharp filter would be seeded as if it were matter.
    device, filled = projections.device if device is None else device, fill_rows(projections)
    shared = fdk_by_ranks(fdk_cuda_tensor, filled, geometry, grid, orbit, "hann")
    return fdk_on_device(filled, geometry, grid, orbit, "hann", device) if shared is None else shared


def fill_rows(projections: torch.Tensor) -> torch.Tensor:
    """Pixels that are not finite interpolated linearly along their row, as by `defects.fill_invalid`.

    Beyond the last good pixel the row goes on as it ends; a row without any becomes 0.
    """
    spoiled = (~torch.isfinite(projections)).any(dim=2).any(dim=1).nonzero()[:, 0]
    if not len(spoiled):
        return projections
    filled = projections.clone()
    at_once = max(1, _AT_ONCE[projections.device.type] // projections[0].numel())
    for views in spoiled.split(at_once):
        filled[views] = _filled(projections[views])
    return filled


def _filled(values: torch.Tensor) -> torch.Tensor:
    good, count = torch.isfinite(values), values.shape[2]
    column = torch.arange(count, device=values.device).expand_as(values)
    before = torch.where(good, column, -1).cummax(dim=2).values
    after = torch.where(good, column, count).flip(2).cummin(dim=2).values.flip(2)
    some = good.any(dim=2, keepdim=True)
    left = torch.where(before < 0, after, before).clamp(max=count - 1)
    right = torch.where(after == count, before, after).clamp(min=0)
    usable = torch.where(good, values, 0.0)
    low, high = usable.gather(2, left), usable.gather(2, right)
    # In the type of the values, whatever the caller's default for quotients of whole numbers.
    share = (column - left).to(values.dtype) / (right - left).clamp(min=1)
    return torch.where(good, values, torch.where(some, low + share * (high - low), 0.0))
