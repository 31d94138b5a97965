"""Weights of filtered backprojection for a circular orbit.

With the source at distance R from the axis, D from the plane of the detector and s measured on it, changing
the variables of parallel-beam inversion to view and s gives, for any in-plane position of the detector,

    f(x) = 1/2 sum over views dbeta kappa(x)^2  h * [ p (A - S).d / (|d| D) ]

where S is the source, A the axis at its height, d the ray from the source to the pixel, kappa(x) the
magnification at x and h the ramp. For the central ray through the axis this is the formula of Feldkamp, Davis
and Kress (J. Opt. Soc. Am. A 1, 612, 1984, doi:10.1364/JOSAA.1.000612). A parallel beam has no magnification
and the obliquity of the detector in place of the last factor.

The plane of the detector need not be upright. Each of its horizontal lines is, seen from the source, one of an upright
detector that is as far away; so D is the distance to the upright plane through the pixel's own line, and s is measured
on that. Where the detector is upright D is the same for all pixels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.orbit import Orbit

__all__ = [
    "arcs_of_rows",
    "horizontal_normal",
    "object_fan",
    "object_radius",
    "obliquity",
    "pixel_weights",
    "ray_arcs",
    "ray_offsets",
    "reach",
    "row_changes",
    "varies",
]


def ray_offsets(
    geometry: Geometry, orbit: Orbit, columns: Sequence[float] | None = None, row: float | None = None
) -> np.ndarray:
    """Signed distance from the axis to the rays of a row, (views, columns), of all columns or those that are named.

    The row is the middle one unless told. The same ray measured from its other end has the opposite sign. The offsets
    rise or fall from column to column.
    """
    row = 0.5 * (geometry.rows - 1) if row is None else row
    middle = geometry.corner + row * geometry.v
    column = np.asarray(range(geometry.columns) if columns is None else columns)[None, :, None]
    pixel = (middle[:, None] + column * geometry.u[:, None])[..., :2]
    if geometry.beam == "parallel":
        ray = np.broadcast_to(geometry.origin[:, None, :2], pixel.shape)
    else:
        ray = pixel - geometry.origin[:, None, :2]
    ray = ray / np.linalg.norm(ray, axis=2, keepdims=True)
    local = pixel - orbit.axis
    return ray[..., 0] * local[..., 1] - ray[..., 1] * local[..., 0]


def reach(geometry: Geometry, orbit: Orbit) -> tuple[float, float]:
    """Signed distances from the axis between which every row of every view measures."""
    ends = np.stack(
        [
            np.sort(ray_offsets(geometry, orbit, (0, geometry.columns - 1), row), axis=1)
            for row in (0, 0.5 * (geometry.rows - 1), geometry.rows - 1)
        ]
    )
    return float(ends[..., 0].max()), float(ends[..., 1].min())


def row_changes(geometry: Geometry) -> tuple[np.ndarray, np.ndarray]:
    """How rows differ from the middle one on a detector whose columns are not upright, (views,) each, per row.

    Returns
    -------
    along : (views,) float64
        By how many columns a row's pixels are ahead of those whose rays are above or below them.
    farther : (views,) float64
        By which share the row is farther from the source, horizontally; 0 in a parallel beam.
    """
    u, v = geometry.u, geometry.v
    if geometry.beam == "parallel":
        return _turn(geometry.origin, v) / _turn(geometry.origin, u), np.zeros(geometry.views)
    ray = geometry.corner + 0.5 * (geometry.rows - 1) * v - geometry.origin
    return _turn(ray, v) / _turn(ray, u), _turn(u, v) / _turn(u, ray)


def varies(arcs: np.ndarray) -> bool:
    """Whether `ray_arcs` differ from column to column."""
    return bool((arcs != arcs[:, :1]).any())


def obliquity(geometry: Geometry) -> np.ndarray:
    """What a parallel beam's projections are to be divided by, (views,).

    That is the cosine between the rays and the normal of the upright planes, and the lengthening of rays that are not
    horizontal.
    """
    beam = geometry.origin / np.linalg.norm(geometry.origin, axis=1, keepdims=True)
    across = np.abs(np.einsum("vk,vk->v", horizontal_normal(geometry), beam))
    return across / (1.0 - beam[:, 2] ** 2)


def _turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The vertical part of the cross product, (views,)."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def horizontal_normal(geometry: Geometry) -> np.ndarray:
    """Unit normal of the upright planes through the detector's level lines, (views, 3)."""
    normal = np.cross(geometry.u, geometry.v * (0.0, 0.0, 1.0))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return normal


def object_radius(grid: VolumeGrid, orbit: Orbit) -> float:
    """How far from the axis an object reaches that fills the ellipse inscribed in the window."""
    return float(np.hypot(*(grid.centre[:2] - orbit.axis)) + 0.5 * grid.extent[:2].max())


def object_fan(grid: VolumeGrid, orbit: Orbit) -> float:
    """Angle at the source between the axis and the rim of that object; 0 in a parallel beam."""
    return float(np.arcsin(min(object_radius(grid, orbit) / orbit.radius, 1.0)))


def ray_arcs(geometry: Geometry, orbit: Orbit, grid: VolumeGrid) -> np.ndarray:
    """Part of half a turn that each ray stands for among all of its distance from the axis, (views, columns) radians.

    Those are the rays of the middle row, of which `arcs_of_rows` makes those of the others.

    That is its view's share of the arc times a weight; the weights of a line's measurements sum to 1. A full turn
    measures every line twice: half each, or, where the detector is too short on one side, a smooth passage to the
    side that sees all (half-fan scans; the idea is Wang's, Med. Phys. 29, 1634, 2002, doi:10.1118/1.1489043). Part
    of a turn in a cone beam takes Parker's weights (Med. Phys. 9, 254, 1982, doi:10.1118/1.595078) over all of the
    arc.
    """
    steps, every = orbit.steps[:, None], (geometry.views, geometry.columns)
    if orbit.full:
        low, high = reach(geometry, orbit)
        overlap = min(-low, high)
        pitch = (high - low) / max(geometry.columns - 1, 1)
        if overlap >= object_radius(grid, orbit) or abs(high + low) < 2 * pitch:
            return np.broadcast_to(0.5 * steps, every)
        offsets = ray_offsets(geometry, orbit)
        side = 1.0 if high > -low else -1.0
        return steps * (0.5 + 0.5 * np.sin(0.5 * np.pi * np.clip(side * offsets / overlap, -1.0, 1.0)))
    if geometry.beam == "parallel":
        return np.broadcast_to(steps, every)
    fan = np.arcsin(np.clip(ray_offsets(geometry, orbit) / orbit.radius, -1.0, 1.0))
    return _parker(orbit, fan, min(float(np.abs(fan).max()), object_fan(grid, orbit)))


def _parker(orbit: Orbit, fan: np.ndarray, widest: float) -> np.ndarray:
    """Parker's weights times shares of the arc for rays at angle ``fan`` from the axis, (views, columns).

    The weights are integrated over each view's share instead of being taken at its middle: the narrower the fan,
    the steeper they rise, and where it is narrower than a step they are a box. Arcs that lack part of a step, such
    as those from 0 to 180 degrees without the last view, are complete once either end takes half of it.
    """
    lack = np.clip(np.pi + 2 * widest - orbit.arc, 0.0, orbit.steps.max())
    arc = orbit.arc + lack
    order = np.argsort(orbit.angles, kind="stable")
    shares = orbit.steps[order]
    shares[[0, -1]] += 0.5 * lack
    ends = np.cumsum(shares)
    high = np.empty_like(shares)
    high[order] = ends
    low = np.empty_like(shares)
    low[order] = ends - shares
    low, high = low[:, None], high[:, None]
    margin = max(0.5 * (arc - np.pi), 0.0)
    fan = np.clip(fan, -margin, margin)
    rising = _risen(high, margin - fan) - _risen(low, margin - fan)
    falling = _risen(arc - low, margin + fan) - _risen(arc - high, margin + fan)
    return np.maximum(rising + falling - (high - low), 0.0)


def _risen(to: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Integral from 0 on of ``sin^2(pi/4 x/half)`` up to ``x = 2 half`` and of 1 beyond."""
    share = np.minimum(np.maximum(to, 0.0) / np.maximum(2 * half, 1e-12), 1.0)
    return np.where(share < 1, half * (share - np.sin(np.pi * share) / np.pi), to - half)


def arcs_of_rows(
    arcs: torch.Tensor, along: torch.Tensor, farther: torch.Tensor, *, rows: torch.Tensor
) -> torch.Tensor:
    """What `ray_arcs` gives for the middle row, for rows whose pixels are not above and below those of that row.

    Parameters
    ----------
    arcs : (views, columns) tensor
    along, farther : (views,) tensors
        From `row_changes`.
    rows : (rows,) tensor
        Counted from the middle one.

    Returns
    -------
    (views, rows, columns) tensor
    """
    last = arcs.shape[1] - 1
    column = torch.arange(last + 1, device=arcs.device, dtype=rows.dtype)
    ahead, scale = (rows * change[:, None] for change in (along, farther))
    place = ((column + ahead[..., None]) / (1 + scale[..., None])).clamp_(0, last)
    below = place.floor().clamp_(max=max(last - 1, 0))
    share, index = (place - below).to(arcs.dtype), below.long()
    every = arcs[:, None].expand(index.shape)
    low, high = every.gather(2, index), every.gather(2, (index + 1).clamp_(max=last))
    return low + share * (high - low)


def pixel_weights(geometry: Geometry, orbit: Orbit, arcs: np.ndarray, views: slice) -> np.ndarray:
    """All that multiplies some of the projections before the filter, (views, rows, columns) float32.

    ``arcs`` is `ray_arcs`; the ramp for pixels of size 1 brings a division by the pixel's width.
    """
    part = geometry.select(views)
    width = np.linalg.norm(part.u, axis=1)
    scale = (arcs[views] / width[:, None])[:, None, :]
    along, farther = row_changes(part)
    if (along.any() or farther.any()) and varies(arcs):
        rows = torch.arange(part.rows, dtype=torch.float64) - 0.5 * (part.rows - 1)
        told = (torch.from_numpy(part) for part in (scale[:, 0], along, farther))
        scale = arcs_of_rows(*told, rows=rows).numpy()
    normal = horizontal_normal(part)
    if part.beam == "parallel":
        scale = np.broadcast_to(scale / obliquity(part)[:, None, None], part.shape)
        return scale.astype(np.float32)
    first = part.corner - part.origin
    depth = np.abs(np.einsum("vk,vk->v", normal, first))
    row, column = np.arange(part.rows)[:, None], np.arange(part.columns)
    # Number by number: products of vectors of three take twice as long.
    x, y, z = (
        first[:, k, None, None] + column * part.u[:, k, None, None] + row * part.v[:, k, None, None]
        for k in range(3)
    )
    towards = (orbit.axis - part.origin[:, :2]) / depth[:, None]
    across = x * towards[:, 0, None, None] + y * towards[:, 1, None, None]
    cosine = across / np.sqrt(x**2 + y**2 + z**2)
    if farther.any():
        depths = np.einsum("vk,vik->vi", normal, first[:, None] + row * part.v[:, None])
        cosine *= np.abs(depth[:, None] / depths)[..., None]
    return (scale * cosine).astype(np.float32)
