"""The rays of a scan and those that ran the same way backwards, by the geometry as it was told."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.scan.dropouts import dropped_rays
from tomo_polysplat.scan.opposite_rays import OppositeRays
from tomo_polysplat.scan.view_geometry import Geometry

__all__ = ["opposite_rays_of"]

# Rows that are compared, and values that are looked at.
_ROWS, _VALUES = 32, 2_000_000
_FEWEST_VIEWS, _FEWEST_COLUMNS = 12, 12
# Relative change of the source's distance from the axis, and of its height, that still is a circle.
_ROUND = 0.02
# Columns by which the axis may wander on the detector, and rows.
_STEADY, _LEVEL = 0.05, 1.0


def opposite_rays_of(
    projections: np.ndarray, geometry: Geometry, valid: np.ndarray | None = None
) -> OppositeRays:
    """The rays that are compared, by rising azimuth, the largest gap at the end.

    Some of all rows of a parallel beam, of a fan or cone the row in the plane of the orbit.

    Parameters
    ----------
    projections, geometry, valid
        See `tomo_polysplat.scan.axis_offset.axis_offset`.

    Raises
    ------
    ValueError
        Where the geometry has no opposite rays.
    """
    if geometry.views < _FEWEST_VIEWS or geometry.columns < _FEWEST_COLUMNS:
        raise ValueError(f"fewer than {_FEWEST_VIEWS} views or {_FEWEST_COLUMNS} columns do not tell")
    azimuth, axis, slope, rows = (_of_parallel if geometry.beam == "parallel" else _of_cone)(geometry)
    order = np.argsort(azimuth, kind="stable")
    azimuth = azimuth[order]
    last = int(np.argmax(np.diff(azimuth, append=azimuth[0] + 2 * np.pi)))
    order, azimuth = np.roll(order, -last - 1), np.roll(azimuth, -last - 1)
    azimuth = np.where(azimuth < azimuth[0], azimuth + 2 * np.pi, azimuth)
    # Read together: a file is gone through as a whole, whichever rows are wanted.
    read = np.split(np.asarray(projections[:, np.concatenate([some for _, some in rows])]), len(rows), axis=1)
    values = sum(share * _values(part, valid, some) for part, (share, some) in zip(read, rows))
    return OppositeRays(np.where(np.isfinite(values), values, np.nan)[order], azimuth, axis, slope)


def _of_parallel(geometry: Geometry) -> tuple[np.ndarray, float, float, list[tuple[float, np.ndarray]]]:
    """Azimuth, column of the axis, slope and rows with their weights of a parallel beam."""
    inverse, reference = geometry.projection_matrices()
    # Points along z stay in their row's height on all views, and in their column.
    along = inverse[:, :2, 2]
    if np.abs(geometry.origin[:, 2]).max() > 1e-6 * np.linalg.norm(geometry.origin, axis=1).min():
        raise ValueError("the beam is inclined to the axis")
    if np.abs(along[:, 0]).max() * geometry.rows > _STEADY * np.abs(along[:, 1]).min():
        raise ValueError("the axis leans on the detector")
    foot = -np.einsum("vkl,vl->vk", inverse[:, :2], reference)
    # Where the axis runs: the point of the plane whose column stays.
    system = np.column_stack([inverse[:, 0, :2], -np.ones(geometry.views)])
    solution, _, rank, _ = np.linalg.lstsq(system, -foot[:, 0], rcond=1e-9)
    if rank < 3 or np.abs(system @ solution + foot[:, 0]).max() > _STEADY:
        raise ValueError("the axis moves on the detector")
    if np.ptp(foot[:, 1]) > _LEVEL:
        raise ValueError("the object moves along the axis")
    most = max(1, min(geometry.rows, _ROWS, _VALUES // (geometry.views * geometry.columns)))
    rows = np.unique(((np.arange(most) + 0.5) * geometry.rows / most).astype(int))
    return np.arctan2(geometry.origin[:, 1], geometry.origin[:, 0]), float(solution[2]), 0.0, [(1.0, rows)]


def _of_cone(geometry: Geometry) -> tuple[np.ndarray, float, float, list[tuple[float, np.ndarray]]]:
    """The same of a fan or cone beam: the plane of the orbit lies between two rows."""
    # |p|^2 = 2 c.p + (r^2 - |c|^2), in coordinates about the mean.
    mean = geometry.origin.mean(axis=0)
    local = (geometry.origin - mean)[:, :2]
    system = np.column_stack([2 * local, np.ones(len(local))])
    centre = np.linalg.lstsq(system, (local**2).sum(axis=1), rcond=None)[0][:2]
    arm = local - centre
    distance = np.hypot(*arm.T)
    if max(np.ptp(distance), np.ptp(geometry.origin[:, 2])) > _ROUND * distance.mean():
        raise ValueError("the source does not go round on a circle")
    inverse, _ = geometry.projection_matrices()
    ahead = np.column_stack([-arm, np.zeros(len(arm))]) / distance[:, None]
    foot = np.einsum("vkl,vl->vk", inverse, ahead)
    foot = foot[:, :2] / foot[:, 2:]
    if np.ptp(foot[:, 0]) > _STEADY or np.ptp(foot[:, 1]) > _LEVEL:
        raise ValueError("the detector moves against the source")
    axis, row = np.median(foot, axis=0)
    if not -0.5 <= row <= geometry.rows - 0.5:
        raise ValueError("the plane of the orbit is not on the detector")
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    depth = np.einsum("vk,vk->v", geometry.corner + axis * geometry.u - geometry.origin, ahead)
    slope = np.median(np.einsum("vk,vk->v", geometry.u[:, :2], left) / depth)
    low = int(np.clip(row, 0, geometry.rows - 1))
    share = float(np.clip(row - low, 0, 1))
    both = [(1 - share, np.array([low])), (share, np.array([min(low + 1, geometry.rows - 1)]))]
    azimuth = np.arctan2(arm[:, 1], arm[:, 0])
    return azimuth, float(axis), float(slope), [part for part in both if part[0] > 1e-3]


def _values(read: np.ndarray, valid: np.ndarray | None, rows: np.ndarray) -> np.ndarray:
    """What was read of some rows, (views, columns, rows) float64, NaN where they are not to be used."""
    values = np.asarray(read, np.float64)
    values = np.where(dropped_rays(values), np.nan, values)
    if valid is not None:
        values = np.where(valid[:, rows], values, np.nan)
    return values.swapaxes(1, 2)
