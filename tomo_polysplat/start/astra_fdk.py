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

    from tomo_polysplat.start.level import LevelRows

__all__ = ["fdk_cuda_tensor", "suits_fdk_cuda", "views_at_once", "weights_on"]

# Numbers, with what rows are padded by, that are filtered at once.
_FILTERED_AT_ONCE = 1 << 24
# Numbers of the views that are backprojected together. ASTRA adds up so many views at a time, so that whole multiples
# of these add up to the same as all views at once.
_AT_ONCE, _GROUP = 1 << 27, 32


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


def views_at_once(pixels: int) -> int:
    """Views of so many pixels each that are filtered and backprojected together."""
    return _GROUP * max(1, _AT_ONCE // (_GROUP * pixels))


def fdk_cuda_tensor(
    projections: torch.Tensor | LevelRows,
    geometry: Geometry,
    grid: VolumeGrid,
    orbit: Orbit,
    filter_name: str,
) -> torch.Tensor:
    """`fdk` of (views, rows, columns) float32 projections on a CUDA device, where the volume stays.

    The detector is level (`start.level`). Corners of the volume beyond the ellipse inscribed in its window, and off the
    detector, miss a part; slices that no view sees are not emptied. Of a large scan some views are filtered and added
    to the volume at a time: besides the volume that takes 12 B for each of `views_at_once`'s numbers.

    Raises
    ------
    RuntimeError
        If ASTRA failed, or had no room.
    """
    from tomo_polysplat.start.astra_pair import AstraPair

    before, after = margins(geometry, ellipse_of(grid))
    wide = replace(
        geometry, columns=before + geometry.columns + after, corner=geometry.corner - before * geometry.u
    )
    area = np.linalg.norm(np.cross(geometry.u, geometry.v), axis=1) / np.prod(grid.voxel_size)
    arcs = ray_arcs(geometry, orbit, grid) * area[:, None]
    length = 1 << (2 * (geometry.columns + max(before, after)) - 1).bit_length()
    response = _there(ramp_response(length, filter_name), projections.device)
    weights = weights_on(projections.device, geometry, orbit, arcs)
    at_once, volume = views_at_once(wide.rows * wide.columns), None
    with AstraPair(wide, grid, projections.device) as pair:
        for first in range(0, geometry.views, at_once):
            some = slice(first, min(first + at_once, geometry.views))
            sinogram = _filtered(projections[some], some, weights, response, before, after)
            views = np.arange(some.start, some.stop)
            if volume is None:
                volume = pair.adjoint(sinogram, views)
            else:
                pair.add_adjoint(volume, sinogram, views)
            # Before the next is made: there may be no room for both.
            del sinogram
    assert volume is not None
    return volume


# Rays, what they are filtered by, and how many columns that makes of them.
def _filtered(
    rays: torch.Tensor,
    views: slice,
    weights: Callable[[slice], torch.Tensor],
    response: torch.Tensor,
    before: int,
    after: int,
) -> torch.Tensor:
    """(views, rows, columns) of some views, filtered, with so many columns more; in memory in ASTRA's order."""
    import torch

    many, rows, columns = rays.shape
    length = 2 * (len(response) - 1)
    sinogram = rays.new_empty((rows, many, before + columns + after))
    at_once = max(1, _FILTERED_AT_ONCE // (rows * length))
    for first in range(0, many, at_once):
        last = min(first + at_once, many)
        weighted = rays[first:last] * weights(slice(views.start + first, views.start + last))
        filtered = torch.fft.irfft(torch.fft.rfft(weighted, length) * response, length).transpose(0, 1)
        if before:
            sinogram[:, first:last, :before] = filtered[..., length - before :]
        sinogram[:, first:last, before:] = filtered[..., : columns + after]
    return sinogram.transpose(0, 1)


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
