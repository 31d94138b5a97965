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

__all__ = ["object_radius", "pixel_weights", "ray_offsets", "redundancy"]


def ray_offsets(geometry: Geometry, orbit: Orbit, columns: Sequence[int] | None = None) -> np.ndarray:
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


def redundancy(geometry: Geometry, orbit: Orbit, grid: VolumeGrid) -> np.ndarray:
    """Weight of each ray among the measurements of the same line, (views, columns).

    The weights of a line's measurements sum to 1. A full turn measures every line twice: half each, or, where
    the detector is too short on one side, a smooth passage to the side that sees all (half-fan scans; the
    idea is Wang's, Med. Phys. 29, 1634, 2002, doi:10.1118/1.1489043). Part of a turn in a cone beam takes
    Parker's weights (Med. Phys. 9, 254, 1982, doi:10.1118/1.595078) over all of the arc.
    """
    offsets = ray_offsets(geometry, orbit)
    if orbit.full:
        low, high = offsets.min(axis=1).max(), offsets.max(axis=1).min()
        overlap = min(-low, high)
        pitch = (high - low) / max(geometry.columns - 1, 1)
        if overlap >= object_radius(grid, orbit) or abs(high + low) < 2 * pitch:
            return np.full_like(offsets, 0.5)
        side = 1.0 if high > -low else -1.0
        return 0.5 + 0.5 * np.sin(0.5 * np.pi * np.clip(side * offsets / overlap, -1.0, 1.0))
    if geometry.beam == "parallel":
        return np.ones_like(offsets)
    return _parker(orbit, np.arcsin(np.clip(offsets / orbit.radius, -1.0, 1.0)))


def _parker(orbit: Orbit, fan: np.ndarray) -> np.ndarray:
    """Parker's weights for rays at angle ``fan`` from the axis, (views, columns)."""
    margin = 0.5 * (orbit.arc - np.pi)
    angle = orbit.angles[:, None]
    fan = np.clip(fan, -0.999 * margin, 0.999 * margin)
    rising = np.clip(angle / (margin - fan), 0.0, 2.0)
    falling = np.clip((orbit.arc - angle) / (margin + fan), 0.0, 2.0)
    return np.sin(0.25 * np.pi * np.minimum(rising, falling)) ** 2


def pixel_weights(geometry: Geometry, orbit: Orbit, share: np.ndarray, views: slice) -> np.ndarray:
    """All that multiplies some of the projections before the filter, (views, rows, columns) float32.

    ``share`` is `redundancy`; the ramp for pixels of size 1 brings a division by the pixel's width.
    """
    part = geometry.select(views)
    width = np.linalg.norm(part.u, axis=1)
    normal = np.cross(part.u, part.v)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    scale = (orbit.steps[views] / width)[:, None, None] * share[views][:, None, :]
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
