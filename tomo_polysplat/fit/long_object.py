"""An object that is longer than the volume: what the rays meet of it above and below.

A ray of a cone beam that crosses the volume runs on above or below it, and meets there what the object goes on with. In
a volume that ends, Gaussians at its ends have to stand for that. Rays that cross nothing of the volume, but matter
beside it, tell nothing of it. On a helix most rays of the first and the last turn do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.fit.inside import NOTHING, typical_ray
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.orbit import Orbit
from tomo_polysplat.start.weights import ray_offsets

__all__ = ["LongObject", "long_object"]

# Views, rows and columns that tell.
_VIEWS, _LINES = 48, 256
# Of the outermost rows that see matter, so many say how wide it is there.
_OUTER = 3
# The object is no wider than this share of the way to the source.
_WIDEST = 0.9
# Where a view is looked at alone, means over such a part of its columns have less noise.
_PARTS = 32


@dataclass(frozen=True)
class LongObject:
    """What rays meet beyond the ends of a volume.

    Attributes
    ----------
    lower, upper : float
        Heights between which rays that cross the volume meet matter; those of the volume where it is no longer.
    missed : (views, rows) bool array
        Rows whose rays pass above or below the volume where the object goes on.
    """

    lower: float
    upper: float
    missed: np.ndarray


def long_object(
    projections: np.ndarray, geometry: Geometry, grid: VolumeGrid, orbit: Orbit, radius: float = 0.0
) -> LongObject:
    """Where an object ends that is longer than the volume, as far as rays through the volume meet it.

    A ray at the height h above the axis is at ``h (d - r) / d`` where it enters a cylinder of radius r about the axis,
    and at ``h (d + r) / d`` where it leaves it, with the source's distance d and heights from the source. An object
    whose end is seen is as high as the outermost row says at its near side; one that the detector cuts may be as
    high as that row's ray is at its far side.

    Parameters
    ----------
    projections : (views, rows, columns) array
        -log(I/I0); NaN for rays that are not to be used.
    geometry, grid : Geometry, VolumeGrid
    orbit : Orbit
        Of the geometry, whose sources may lie at any height (`start.orbit.find_turns`).
    radius : float
        Of the object about the axis at least, where the detector does not show it.
    """
    missed = np.zeros((geometry.views, geometry.rows), bool)
    volume = float(grid.lower[2]), float(grid.upper[2])
    ends, half = list(volume), 0.5 * float(grid.voxel_size[2])
    heights, source = _heights(geometry, orbit)
    looks = _looks(projections, together=float(np.ptp(heights.mean(axis=(1, 2)))) < half)
    if geometry.rows < 2 or not looks.seen.any():
        return LongObject(ends[0], ends[1], missed)
    for k, up in enumerate((-1.0, 1.0)):
        # Seen so that this end is above, and from the sources.
        height = up * (heights - source[:, None, None])
        end, other = up * (volume[k] - source), up * (volume[1 - k] - source)
        outer, cut, wide = looks.outermost(looks.of(height.mean(axis=2)))
        offsets = np.abs(ray_offsets(geometry, orbit, looks.columns[wide].tolist()))
        near = _near(max(radius, float(offsets.mean(axis=0).max())), orbit)
        lowest, highest = np.sort([outer * near, outer * (2 - near)], axis=0)
        matter = np.where(cut, highest, lowest)
        at_least = lowest + looks.of(up * source)
        if not cut[best := int(at_least.argmax())]:
            # Where it ends is seen, and it ends there for those who do not see it.
            matter = np.minimum(matter, at_least[best] - looks.of(up * source))
        if float((matter - looks.of(end)).max()) <= half:
            continue
        ways = np.stack([height * near, height * (2 - near)])
        nearest, farthest = ways.min(axis=(0, 3)), ways.max(axis=(0, 3))
        crossed = looks.of(((nearest <= end[:, None]) & (farthest >= other[:, None])).any(axis=1) + 0.0) > 0
        times = (2 - near) / near
        reached = np.minimum(matter, looks.of(np.maximum(end * times, end / times))) - looks.of(end)
        ends[k] += up * float(reached[crossed].max(initial=0.0))
        missed |= nearest > end[:, None]
    return LongObject(ends[0], ends[1], missed)


def _near(radius: float, orbit: Orbit) -> float:
    """Height at which a ray enters the object, over its height at the axis. It leaves the object at 2 less this."""
    return 1.0 if math.isinf(orbit.radius) else 1.0 - min(radius / orbit.radius, _WIDEST)


@dataclass(frozen=True)
class _Looks:
    """What some views show: all of them together where they look at the same height, or each one alone.

    Attributes
    ----------
    views : (looks,) int array or None
        Which ones they are; None together.
    rows, columns : int array
        Of those that are looked at.
    seen : (looks, rows, columns) bool array
        Whether rays see matter.
    told : (looks, rows) bool array
        Whether there are any rays.
    """

    views: np.ndarray | None
    rows: np.ndarray
    columns: np.ndarray
    seen: np.ndarray
    told: np.ndarray

    def of(self, values: np.ndarray) -> np.ndarray:
        """(looks, ...) of what is told for every view."""
        return values.mean(axis=0, keepdims=True) if self.views is None else values[self.views]

    def outermost(self, height: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of rows (looks, rows) at these heights: that of the last one that sees matter, -inf if none does; whether it
        is the last one there is; and which columns see matter in the last few."""
        height = height[:, self.rows]
        matter = np.where(self.seen.any(axis=2), height, -np.inf)
        outer = matter.max(axis=1)
        cut = outer >= np.where(self.told, height, -np.inf).max(axis=1)
        last = np.sort(matter, axis=1)[:, -_OUTER:][:, :1]
        wide: Any = (self.seen & (matter >= last)[..., None]).any(axis=(0, 1))
        return outer, cut, wide


def _looks(projections: np.ndarray, together: bool) -> _Looks:
    """Some of the views."""
    from scipy.ndimage import uniform_filter1d

    views, rows, columns = projections.shape
    at_rows, at_columns = (evenly_spread(n, _LINES) for n in (rows, columns))
    number = np.arange(0, views, max(1, views // _VIEWS))
    some = np.stack([projections[view][np.ix_(at_rows, at_columns)] for view in number])
    good = np.isfinite(some)
    values = np.where(good, some, 0.0)
    weight = good + 0.0
    if together:
        sums, weights = values.sum(axis=0, keepdims=True), weight.sum(axis=0, keepdims=True)
    else:
        width = max(1, len(at_columns) // _PARTS)
        sums, weights = (uniform_filter1d(part, width, axis=2, mode="constant") for part in (values, weight))
    seen = sums > NOTHING * typical_ray(values) * np.maximum(weights, 1e-3)
    told = good.any(axis=(0, 2))[None] if together else good.any(axis=2)
    return _Looks(None if together else number, at_rows, at_columns, seen, told)


def _heights(geometry: Geometry, orbit: Orbit) -> tuple[np.ndarray, np.ndarray]:
    """(views, rows, 2) heights of rays above the axis, at both ends of each row, and (views,) of the sources."""
    row, column = np.arange(geometry.rows)[None, :, None, None], np.array([0, geometry.columns - 1])
    corner, u, v = (part[:, None, None] for part in (geometry.corner, geometry.u, geometry.v))
    pixel = corner + row * v + column[:, None] * u
    if geometry.beam == "parallel":
        beam = geometry.origin[:, None, None]
        across = np.linalg.norm(beam[..., :2], axis=-1)
        way = ((orbit.axis - pixel[..., :2]) * beam[..., :2]).sum(axis=-1) / across**2
        return pixel[..., 2] + way * beam[..., 2], np.zeros(geometry.views)
    origin = geometry.origin[:, None, None]
    toward = orbit.axis - origin[..., :2]
    way = (toward**2).sum(axis=-1) / ((pixel - origin)[..., :2] * toward).sum(axis=-1)
    return origin[..., 2] + way * (pixel - origin)[..., 2], geometry.origin[:, 2]
