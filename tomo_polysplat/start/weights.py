"""Weights of filtered backprojection for a circular orbit.

With the source at distance R from the axis, D from the plane of the detector and s measured on it, changing
the variables of parallel-beam inversion to view and s gives, for any in-plane position of the detector,

    f(x) = 1/2 sum over views dbeta kappa(x)^2  h * [ p (A - S).d / (|d| D) ]

where S is the source, A the axis at its height, d the ray from the source to the pixel, kappa(x) the
magnification at x and h the ramp. For the central ray through the axis this is the formula of Feldkamp, Davis
and Kress (J. Opt. Soc. Am. A 1, 612, 1984, doi:10.1364/JOSAA.1.000612). A parallel beam has no magnification
and the obliquity of the detector in place of the last factor.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.orbit import Orbit

__all__ = ["object_fan", "object_radius", "pixel_weights", "ray_arcs", "ray_offsets"]


def ray_offsets(geometry: Geometry, orbit: Orbit, columns: Sequence[float] | None = None) -> np.ndarray:
    """Signed distance from the axis to the rays of the middle row, (views, columns), all or those that are named.

    The same ray measured from its other end has the opposite sign. The offsets rise or fall from column to column.
    """
    middle = geometry.corner + 0.5 * (geometry.rows - 1) * geometry.v
    column = np.asarray(range(geometry.columns) if columns is None else columns)[None, :, None]
    pixel = (middle[:, None] + column * geometry.u[:, None])[..., :2]
    if geometry.beam == "parallel":
        ray = np.broadcast_to(geometry.origin[:, None, :2], pixel.shape)
    else:
        ray = pixel - geometry.origin[:, None, :2]
    ray = ray / np.linalg.norm(ray, axis=2, keepdims=True)
    local = pixel - orbit.axis
    return ray[..., 0] * local[..., 1] - ray[..., 1] * local[..., 0]


def object_radius(grid: VolumeGrid, orbit: Orbit) -> float:
    """How far from the axis an object reaches that fills the ellipse inscribed in the window."""
    return float(np.hypot(*(grid.centre[:2] - orbit.axis)) + 0.5 * grid.extent[:2].max())


def object_fan(grid: VolumeGrid, orbit: Orbit) -> float:
    """Angle at the source between the axis and the rim of that object; 0 in a parallel beam."""
    return float(np.arcsin(min(object_radius(grid, orbit) / orbit.radius, 1.0)))


def ray_arcs(geometry: Geometry, orbit: Orbit, grid: VolumeGrid) -> np.ndarray:
    """Part of half a turn that each ray stands for among all of its distance from the axis, (views, columns) radians.

    That is its view's share of the arc times a weight; the weights of a line's measurements sum to 1. A full turn
    measures every line twice: half each, or, where the detector is too short on one side, a smooth passage to the
    side that sees all (half-fan scans; the idea is Wang's, Med. Phys. 29, 1634, 2002, doi:10.1118/1.1489043). Part
    of a turn in a cone beam takes Parker's weights (Med. Phys. 9, 254, 1982, doi:10.1118/1.595078) over all of the
    arc.
    """
    steps, every = orbit.steps[:, None], (geometry.views, geometry.columns)
    if orbit.full:
        ends = ray_offsets(geometry, orbit, (0, geometry.columns - 1))
        low, high = ends.min(axis=1).max(), ends.max(axis=1).min()
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


def pixel_weights(geometry: Geometry, orbit: Orbit, arcs: np.ndarray, views: slice) -> np.ndarray:
    """All that multiplies some of the projections before the filter, (views, rows, columns) float32.

    ``arcs`` is `ray_arcs`; the ramp for pixels of size 1 brings a division by the pixel's width.
    """
    part = geometry.select(views)
    width = np.linalg.norm(part.u, axis=1)
    normal = np.cross(part.u, part.v)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    scale = (arcs[views] / width[:, None])[:, None, :]
    if part.beam == "parallel":
        beam = part.origin / np.linalg.norm(part.origin, axis=1, keepdims=True)
        obliquity = np.abs(np.einsum("vk,vk->v", normal, beam))
        scale = np.broadcast_to(scale / obliquity[:, None, None], part.shape)
        return scale.astype(np.float32)
    first = part.corner - part.origin
    depth = np.abs(np.einsum("vk,vk->v", normal, first))
    row = np.arange(part.rows)[None, :, None, None]
    column = np.arange(part.columns)[None, None, :, None]
    ray = first[:, None, None] + column * part.u[:, None, None] + row * part.v[:, None, None]
    to_axis = np.pad(orbit.axis - part.origin[:, :2], ((0, 0), (0, 1)))
    cosine = np.einsum("vijk,vk->vij", ray, to_axis / depth[:, None]) / np.linalg.norm(ray, axis=3)
    return (scale * cosine).astype(np.float32)
