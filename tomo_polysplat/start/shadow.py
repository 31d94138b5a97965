"""Where the shadow of a volume falls on the detector."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.orbit import Orbit

__all__ = ["corners_of", "ellipse_of", "margins", "slices_seen"]

# Points on the ellipse, which is larger than their polygon by half a percent.
_POINTS = 32


def corners_of(grid: VolumeGrid) -> np.ndarray:
    """The corners of a volume's window, (8, 3)."""
    return np.stack(np.meshgrid(*zip(grid.lower, grid.upper), indexing="ij"), axis=-1).reshape(-1, 3)


def ellipse_of(grid: VolumeGrid) -> np.ndarray:
    """The rim of the ellipse inscribed in the window, at its two ends along z, (n, 3)."""
    turn = np.linspace(0, 2 * np.pi, _POINTS, endpoint=False)
    rim = grid.centre[:2] + 0.5 * grid.extent[:2] * np.column_stack([np.cos(turn), np.sin(turn)])
    return np.concatenate(
        [np.column_stack([rim, np.full(_POINTS, z)]) for z in (grid.lower[2], grid.upper[2])]
    )


def margins(geometry: Geometry, points: np.ndarray) -> tuple[int, int]:
    """Columns beyond either end of the detector on which points (n, 3) cast a shadow, at most its width."""
    columns = geometry.project_points(points)[..., 0]
    before, after = -np.nanmin(columns), np.nanmax(columns) - (geometry.columns - 1)
    return tuple(int(np.clip(np.ceil(n), 0, geometry.columns)) for n in (before, after))  # type: ignore[return-value]


def slices_seen(geometry: Geometry, grid: VolumeGrid, orbit: Orbit) -> np.ndarray:
    """Slices whose point on the axis falls on the detector in most views, (nz,) bool."""
    z = grid.axes()[2]
    # A voxel counts as seen as soon as any of it is, so the margin is half a voxel and half a pixel.
    margin = 0.5 + 0.5 * grid.voxel_size[2] / geometry.pixel_size_at(grid.centre)[1]

    def seen(heights: np.ndarray) -> np.ndarray:
        points = np.column_stack([np.broadcast_to(orbit.axis, (len(heights), 2)), heights])
        row = geometry.project_points(points)[..., 1]
        return (row > -margin) & (row < geometry.rows - 1 + margin)

    # What lies between two points on the detector is on it as well.
    ends_are = seen(z[[0, -1]]).all()
    return np.ones(len(z), bool) if ends_are else seen(z).mean(axis=0) >= 0.5
