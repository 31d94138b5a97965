"""Filtered backprojection on a GPU: weights and filter by torch, backprojection by ASTRA.

ASTRA's FDK_CUDA wants a centred detector and a full turn in even steps. Its backprojection takes any views, and gives
each the weight V (D/d)^2 / A: voxel's volume, distances from the source to the detector and to the voxel, area of a
pixel. That is FDK's weight but for the constant V / A (1/A without the distances in a parallel beam).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.filters import ramp_response
from tomo_polysplat.start.orbit import Orbit
from tomo_polysplat.start.shadow import ellipse_of, margins
from tomo_polysplat.start.weights import (
    arcs_of_rows,
    horizontal_normal,
    obliquity,
    ray_arcs,
    row_changes,
    varies,
)

if TYPE_CHECKING:
    import torch

__all__ = ["fdk_cuda_tensor", "suits_fdk_cuda", "weights_on"]

# Numbers, with what rows are padded by, that are filtered at once.
_FILTERED_AT_ONCE = 1 << 24


def suits_fdk_cuda(geometry: Geometry) -> tuple[bool, str]:
    """Whether a scan that `fits_fdk` can be done on a GPU, and why not.

    Without a usable GPU ASTRA would end the process, so that is asked first.
    """
    from tomo_polysplat.start.astra_pair import astra_has_gpu

    if not astra_has_gpu():
        return False, "no GPU that ASTRA can use"
    if geometry.planar:
        return False, "not a 3D scan"
    return True, "a 3D scan"


def fdk_cuda_tensor(
    projections: torch.Tensor, geometry: Geometry, grid: VolumeGrid, orbit: Orbit, filter_name: str
) -> torch.Tensor:
    """`fdk` of (views, rows, columns) float32 projections on a CUDA device, where the volume stays.

    The detector is level (`start.level`). Corners of the volume beyond the ellipse inscribed in its window, and off the
    detector, miss a part; slices that no view sees are not emptied.

    Raises
    ------
    RuntimeError
        If ASTRA failed, or had no room.
    """
    import torch

    from tomo_polysplat.start.astra_pair import AstraPair

    views, rows, columns = projections.shape
    before, after = margins(geometry, ellipse_of(grid))
    wide = replace(geometry, columns=before + columns + after, corner=geometry.corner - before * geometry.u)
    area = np.linalg.norm(np.cross(geometry.u, geometry.v), axis=1) / np.prod(grid.voxel_size)
    arcs = ray_arcs(geometry, orbit, grid) * area[:, None]
    length = 1 << (2 * (columns + max(before, after)) - 1).bit_length()
    response = torch.from_numpy(ramp_response(length, filter_name)).to(projections)
    # In ASTRA's order.
    sinogram = projections.new_empty((rows, views, wide.columns))
    at_once, weights = (
        max(1, _FILTERED_AT_ONCE // (rows * length)),
        weights_on(projections.device, geometry, orbit, arcs),
    )
    for first in range(0, views, at_once):
        some = slice(first, min(first + at_once, views))
        weighted = projections[some] * weights(some)
        filtered = torch.fft.irfft(torch.fft.rfft(weighted, length) * response, length).transpose(0, 1)
        if before:
            sinogram[:, some, :before] = filtered[..., length - before :]
        sinogram[:, some, before:] = filtered[..., : columns + after]
    with AstraPair(wide, grid, projections.device) as pair:
        return pair.adjoint(sinogram.transpose(0, 1), np.arange(views))


def weights_on(
    device: torch.device, geometry: Geometry, orbit: Orbit, arcs: np.ndarray
) -> Callable[[slice], torch.Tensor]:
    """What gives `pixel_weights` of some views on a device, (views, rows, columns) or (views, 1, columns) float32.

    Lengths of rays and their parts towards the axis are polynomials in row and column: no ray is stored.
    """
    scale = arcs / np.linalg.norm(geometry.u, axis=1)[:, None]
    if geometry.beam == "parallel":
        return _shares_on(device, geometry, scale / obliquity(geometry)[:, None])
    shares = _shares_on(device, geometry, scale)
    # Seen from the pixel in the middle, so that little is lost in float32.
    rows, columns = _from_middle(geometry.rows), _from_middle(geometry.columns)
    u, v = geometry.u, geometry.v
    ray = geometry.corner - geometry.origin - rows[0] * v - columns[0] * u
    depth = np.abs((horizontal_normal(geometry) * ray).sum(axis=1))
    towards = np.pad(orbit.axis - geometry.origin[:, :2], ((0, 0), (0, 1))) / depth[:, None]
    pairs = (
        (ray, towards),
        (v, towards),
        (u, towards),
        (ray, ray),
        (v, v),
        (u, u),
        (ray, v),
        (ray, u),
        (u, v),
    )
    products = _there(np.stack([(a * b).sum(axis=1) for a, b in pairs]), device)[..., None, None]
    row, column = _there(rows, device)[:, None], _there(columns, device)
    _, farther = row_changes(geometry)
    tilted, change = bool(farther.any()), _there(farther, device)[:, None, None]

    def weights(some: slice) -> torch.Tensor:
        rt, vt, ut, rr, vv, uu, rv, ru, uv = products[:, some]
        squared = rr + row * (row * vv + 2 * rv) + column * (column * uu + 2 * ru + 2 * row * uv)
        found = shares(some) * (rt + row * vt + column * ut) * squared.rsqrt()
        return found / (1 + row * change[some]) if tilted else found

    return weights


def _shares_on(
    device: torch.device, geometry: Geometry, scale: np.ndarray
) -> Callable[[slice], torch.Tensor]:
    """What gives (views, rows, columns) of some views, or (views, 1, columns), for numbers of the middle row."""
    scales = _there(scale, device)
    along, farther = row_changes(geometry)
    if not ((along.any() or farther.any()) and varies(scale)):
        return lambda some: scales[some, None]
    changes, rows = (
        (_there(along, device), _there(farther, device)),
        _there(_from_middle(geometry.rows), device),
    )
    return lambda some: arcs_of_rows(*(part[some] for part in (scales, *changes)), rows=rows)


def _from_middle(count: int) -> np.ndarray:
    return np.arange(count) - 0.5 * (count - 1)


def _there(values: np.ndarray, device: torch.device) -> torch.Tensor:
    import torch

    return torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(device)
