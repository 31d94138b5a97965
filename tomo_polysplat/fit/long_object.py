"""An object that is longer than the volume: what of it the rays of a circular orbit meet above and below.

A ray of a cone beam that crosses the volume runs on above or below it, and meets there what the object goes on with. In
a volume that ends, Gaussians at its ends have to stand for that. Those rows of the detector whose rays cross nothing
of the volume, but matter beside it, tell nothing of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

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


@dataclass(frozen=True)
class LongObject:
    """What rays meet beyond the ends of a volume.

    Attributes
    ----------
    lower, upper : float
        Heights between which rays that cross the volume meet matter; those of the volume where it is no longer.
    missed : (rows,) bool array
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
    and at ``h (d + r) / d`` where it leaves it, with the source's distance d and heights from the source's plane. An
    object whose end is seen is as high as the outermost row says at its near side; one that the detector cuts may be as
    high as that row's ray is at its far side.

    Parameters
    ----------
    projections : (views, rows, columns) array
        -log(I/I0); NaN for rays that are not to be used.
    geometry, grid : Geometry, VolumeGrid
    orbit : Orbit
        Of the geometry.
    radius : float
        Of the object about the axis at least, where the detector does not show it.
    """
    rows = geometry.rows
    missed, ends = np.zeros(rows, bool), [float(grid.lower[2]), float(grid.upper[2])]
    seen, at_rows, at_columns, told = _profile(projections)
    if rows < 2 or not seen.any():
        return LongObject(ends[0], ends[1], missed)
    heights, source = _heights(geometry, orbit)
    half = 0.5 * float(grid.voxel_size[2])
    for k, up in enumerate((-1.0, 1.0)):
        # Seen so that this end is above; the plane of the source is at 0.
        height, end = up * (heights - source), up * (ends[k] - source)
        middle = height.mean(axis=(0, 2))
        outward = np.argsort(middle[at_rows])
        outer = [row for row in outward[::-1] if seen[row].any()][:_OUTER]
        wide = seen[outer].any(axis=0)
        offsets = np.abs(ray_offsets(geometry, orbit, at_columns[wide].tolist(), float(at_rows[outer[0]])))
        near = _near(max(radius, float(offsets.mean(axis=0).max())), orbit)
        cut = outer[0] == [row for row in outward if told[row]][-1]
        sides = middle[at_rows[outer[0]]] * np.array([near, 2 - near])
        matter = sides.max() if cut else sides.min()
        if matter <= end + half:
            continue
        times = (2 - near) / near
        ends[k] = source + up * min(matter, max(end * times, end / times))
        missed |= (np.minimum(height * near, height * (2 - near)) > end).all(axis=(0, 2))
    return LongObject(ends[0], ends[1], missed)


def _near(radius: float, orbit: Orbit) -> float:
    """Share of its height at the axis at which a ray enters the object; it leaves it at 2 less this."""
    return 1.0 if math.isinf(orbit.radius) else 1.0 - min(radius / orbit.radius, _WIDEST)


def _profile(projections: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(rows, columns) whether some rays see matter, which ones they are, and which of the rows have any ray."""
    views, rows, columns = projections.shape
    at = [np.unique(np.linspace(0, n - 1, min(n, _LINES)).round().astype(int)) for n in (rows, columns)]
    some = np.stack([view[np.ix_(*at)] for view in projections[:: max(1, views // _VIEWS)]])
    good = np.isfinite(some)
    values = np.where(good, some, 0.0)
    mean = values.sum(axis=0) / np.maximum(good.sum(axis=0), 1)
    return mean > NOTHING * typical_ray(values), *at, good.any(axis=(0, 2))


def _heights(geometry: Geometry, orbit: Orbit) -> tuple[np.ndarray, float]:
    """(views, rows, 2) heights of rays above the axis, at both ends of each row, and that of the source."""
    row, column = np.arange(geometry.rows)[None, :, None, None], np.array([0, geometry.columns - 1])
    corner, u, v = (part[:, None, None] for part in (geometry.corner, geometry.u, geometry.v))
    pixel = corner + row * v + column[:, None] * u
    if geometry.beam == "parallel":
        beam = geometry.origin[:, None, None]
        across = np.linalg.norm(beam[..., :2], axis=-1)
        way = ((orbit.axis - pixel[..., :2]) * beam[..., :2]).sum(axis=-1) / across**2
        return pixel[..., 2] + way * beam[..., 2], 0.0
    origin = geometry.origin[:, None, None]
    toward = orbit.axis - origin[..., :2]
    way = (toward**2).sum(axis=-1) / ((pixel - origin)[..., :2] * toward).sum(axis=-1)
    return origin[..., 2] + way * (pixel - origin)[..., 2], float(geometry.origin[:, 2].mean())
