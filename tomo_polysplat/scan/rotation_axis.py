"""Where the axis of rotation is, and from where each view looks, by the geometry that is told."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.scan.view_geometry import Geometry
from tomo_polysplat.scan.volume_grid import VolumeGrid

__all__ = ["axis_column", "azimuth_of_views", "reach_of", "rotation_axis"]


def rotation_axis(geometry: Geometry) -> np.ndarray:
    """A point (x, y, z) of the axis: the centre of the sources' circle, or the origin of parallel rays."""
    if geometry.beam == "parallel":
        return np.zeros(3)
    # |p|^2 = 2 c.p + (r^2 - |c|^2), in coordinates about the mean.
    mean = geometry.origin.mean(axis=0)
    local = (geometry.origin - mean)[:, :2]
    system = np.column_stack([2 * local, np.ones(len(local))])
    solution = np.linalg.lstsq(system, (local**2).sum(axis=1), rcond=None)[0]
    return mean + np.array([solution[0], solution[1], 0.0])


def axis_column(geometry: Geometry) -> float:
    """Column on which the axis falls, in the median of the views."""
    return float(np.median(geometry.project_points(rotation_axis(geometry)[None])[:, 0, 0]))


def azimuth_of_views(geometry: Geometry) -> np.ndarray:
    """Angle of the source, or of the beam, about z in radians, (views,)."""
    beside = geometry.origin if geometry.beam == "parallel" else geometry.origin - rotation_axis(geometry)
    return np.arctan2(beside[:, 1], beside[:, 0])


def reach_of(geometry: Geometry, grid: VolumeGrid) -> float:
    """Columns from the axis to a side of the volume, where that is seen the widest."""
    sides = 0.5 * grid.extent * np.vstack([np.eye(3)[:2], -np.eye(3)[:2]])
    columns = geometry.project_points(grid.centre + sides)[..., 0]
    apart = np.abs(columns - axis_column(geometry))
    return float(apart[np.isfinite(apart)].max(initial=0.0))
