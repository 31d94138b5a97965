"""How much of what varies in a volume is the object's, told by two volumes of half the views each."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from tomo_polysplat.scan.defects import fill_invalid
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.fdk import fdk, fits_fdk
from tomo_polysplat.start.initial import FEW_VIEWS
from tomo_polysplat.start.on_gpu import fdk_on_gpu
from tomo_polysplat.start.whole_rows import Continuation, WholeRows

__all__ = ["halves_agree", "places_of_views"]

# Pairs of voxels that tell a chance from a rule.
_FEWEST = 1000
# Share of the mean step from view to view below which two views are from the same place.
_SAME_PLACE = 0.1
# Voxels that are looked at together.
_AT_ONCE = 1 << 24
# Voxels times views beyond which a CPU would spend longer on the two volumes than on much else.
_MOST_ADDITIONS = 5e9


def halves_agree(
    projections: torch.Tensor,
    geometry: Geometry,
    grid: VolumeGrid,
    bodies: Sequence[torch.Tensor],
    device: torch.device | None = None,
) -> list[float | None]:
    """Mean over pairs of neighbouring voxels of whether two half scans see the same one as the denser.

    The halves are every other view, and views from one place go to the same half. Noise is independent in them, and
    the streaks of too few views are opposite, so that of homogeneous matter the sign of a difference in one tells
    nothing of that in the other, or the contrary. Where the object has texture that the scan resolves, they agree.
    Structural biologists compare half maps so to tell resolution (Harauz and van Heel 1986).

    Parameters
    ----------
    projections : (views, rows, columns) tensor
        -log(I/I0); NaN where a ray is not to be used.
    geometry, grid : Geometry, VolumeGrid
    bodies : sequence of (nz, ny, nx) bool tensors
        Voxels of a kind of matter each.
    device : torch.device, optional
        Where the volumes are made; where the projections are by default.

    Returns
    -------
    list of float or None
        For each body, 1 where all agree, 0 by chance, -1 where none does. None where it has too few voxels to tell, or
        where no two volumes can be made by filtered backprojection, or not in reasonable time.
    """
    nothing: list[float | None] = [None] * len(bodies)
    places = places_of_views(geometry)
    if places.max() + 1 < 2 * FEW_VIEWS:
        return nothing
    halves = []
    for half in (0, 1):
        volume = _half(projections, geometry, grid, np.flatnonzero(places % 2 == half), device)
        if volume is None:
            return nothing
        halves.append(volume.to(bodies[0].device))
    one, other = halves
    counted = [_signs(one, other, body) for body in bodies]
    return [signs / pairs if pairs >= _FEWEST else None for signs, pairs in counted]


def places_of_views(geometry: Geometry) -> np.ndarray:
    """(views,) places from which views are seen, counted round the axis; parallel rays are the same from both ends."""
    turn = np.arctan2(geometry.origin[:, 1], geometry.origin[:, 0])
    turn = np.mod(turn, np.pi if geometry.beam == "parallel" else 2 * np.pi)
    order = np.argsort(turn, kind="stable")
    apart = np.diff(turn[order]) > _SAME_PLACE * np.ptp(turn) / geometry.views
    places = np.empty(geometry.views, int)
    places[order] = np.concatenate([[0], np.cumsum(apart)])
    return places


def _signs(one: torch.Tensor, other: torch.Tensor, body: torch.Tensor) -> tuple[float, int]:
    """Pairs of neighbours of which two volumes agree less those of which they do not, and all pairs."""
    signs, pairs = 0.0, 0
    for axis, length in enumerate(body.shape):
        if length == 1:
            continue
        # By slabs across another axis: to pick voxels of three axes takes 24 bytes for each.
        across = 1 if axis == 0 else 0
        depth = max(1, _AT_ONCE * body.shape[across] // body.numel())
        for first, second, inside in zip(*(part.split(depth, across) for part in (one, other, body))):
            both = inside.narrow(axis, 1, length - 1) & inside.narrow(axis, 0, length - 1)
            product = first.diff(dim=axis)[both].sign() * second.diff(dim=axis)[both].sign()
            signs, pairs = signs + float(product.sum(dtype=torch.float64)), pairs + len(product)
    return signs, pairs


def _half(
    projections: torch.Tensor,
    geometry: Geometry,
    grid: VolumeGrid,
    views: np.ndarray,
    device: torch.device | None,
) -> torch.Tensor | None:
    some = geometry.select(views)
    if not fits_fdk(some, grid)[0]:
        return None
    index = torch.from_numpy(views).to(projections.device)
    device, volume = projections.device if device is None else device, None
    if device.type == "cuda":
        volume = fdk_on_gpu(WholeRows(projections, Continuation(some), index), some, grid, device)
    if volume is None and math.prod(grid.shape) * geometry.views <= _MOST_ADDITIONS:
        array = projections[index].cpu().numpy()
        filled = fill_invalid(array, np.isfinite(array))
        volume = torch.from_numpy(fdk(filled, some, grid, filter_name="hann"))
    return volume
