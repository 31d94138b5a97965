"""What the probes look at, computed once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.scan.apart_columns import apart_columns
from tomo_polysplat.scan.counts import Counts, Marks
from tomo_polysplat.scan.defects import fill_invalid
from tomo_polysplat.scan.dropouts import dropped_rays
from tomo_polysplat.scan.flattened import flattened
from tomo_polysplat.scan.geometry import Geometry, from_astra
from tomo_polysplat.scan.probes.air import Air, look_for_air
from tomo_polysplat.scan.rotation_axis import axis_column, azimuth_of_views, reach_of, rotation_axis
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.scan.volume_grid import VolumeGrid

__all__ = ["Measured"]

# Rows that a probe of the whole scan looks at, evenly spread.
_MOST_ROWS = 32


@dataclass(frozen=True)
class Measured:
    """A scan with what several probes need of it."""

    scan: Scan
    dead_pixels: np.ndarray | None = None
    """Pixels not to look at, (rows, columns)."""
    beam: float = 0.0
    """What all rays hold beside what they pass."""

    def __post_init__(self) -> None:
        # Probes look at pixels where the geometry has them.
        object.__setattr__(self, "scan", flattened(self.scan))

    @cached_property
    def _told(self) -> tuple[Geometry, VolumeGrid]:
        return from_astra(self.scan.proj_geom, self.scan.vol_geom)

    @property
    def geometry(self) -> Geometry:
        return self._told[0]

    @property
    def grid(self) -> VolumeGrid:
        return self._told[1]

    @cached_property
    def valid(self) -> np.ndarray:
        """Rays that are marked good and finite, (rows, views, columns)."""
        values, marked = self.scan.projections, self.scan.valid
        # Counts are judged some views at a time.
        good = np.asarray(values.marks) if isinstance(values, Counts) else np.isfinite(values)
        if marked is not None and not isinstance(marked, Marks):
            good &= marked
        if self.dead_pixels is not None:
            good &= ~self.dead_pixels[:, None]
        return good

    @cached_property
    def chosen_rows(self) -> np.ndarray:
        """The rows of :attr:`filled`: at most 32 of those with a good ray, evenly spread."""
        rows = np.flatnonzero(self.valid.any(axis=(1, 2)))
        if not len(rows):
            rows = np.arange(self.scan.rows)
        return rows[evenly_spread(len(rows), _MOST_ROWS)]

    @cached_property
    def good(self) -> np.ndarray:
        """Which rays of :attr:`filled` were measured."""
        values, valid = self._values, self.valid[self.chosen_rows]
        return valid & ~dropped_rays(np.where(valid, values, np.nan))

    @cached_property
    def filled(self) -> np.ndarray:
        """The chosen rows of the projections, with bad rays interpolated, (rows, views, columns)."""
        filled = fill_invalid(self._values, self.good)
        return filled - np.float32(self.beam) if self.beam else filled

    @cached_property
    def _values(self) -> np.ndarray:
        # Once: a file may have to be read for them.
        return self.scan.projections[self.chosen_rows]

    @cached_property
    def level(self) -> float:
        """What counts as large in this scan: the 99th percentile of its values."""
        return float(np.percentile(self.filled, 99))

    @cached_property
    def span(self) -> float:
        """By how much the values differ: from the 1st to the 99th percentile."""
        low, high = np.percentile(self.filled, [1, 99])
        return float(high - low)

    @cached_property
    def air(self) -> Air | None:
        """Rays beside the object, or None where there are none."""
        return look_for_air(self.filled, self.span, self.axis_column, reach_of(self.geometry, self.grid))

    @cached_property
    def apart(self) -> tuple[np.ndarray, np.ndarray]:
        """Columns unlike their neighbours in nearly all rays: those that no object makes, and those one might."""
        values = np.where(self.valid[self.chosen_rows], self._values, np.nan)
        return apart_columns(values, self.level, self.axis_column, self.azimuth)

    @property
    def axis_column(self) -> float:
        """Column on which the axis of rotation falls, in the median of the views."""
        return axis_column(self.geometry)

    @cached_property
    def places(self) -> np.ndarray:
        """Where each view looks from, (views, n): pixel coordinates of points about the middle of the volume.

        The distance between two views is how far points half-way to the volume's border move, in pixels.
        """
        geometry, grid = self.geometry, self.grid
        steps = np.vstack([np.zeros(3), np.eye(3), -np.eye(3)]) * grid.extent / 4
        if geometry.planar:
            steps = steps[[0, 1, 2, 4, 5]]
        points = geometry.project_points(grid.centre + steps)
        if geometry.planar:
            points = points[..., :1]
        spread = points.reshape(geometry.views, -1) / np.sqrt(len(steps))
        return np.nan_to_num(spread, nan=0.0)

    @cached_property
    def azimuth(self) -> np.ndarray:
        """Angle of the source, or of the beam, about z in radians, per view."""
        return azimuth_of_views(self.geometry)

    @cached_property
    def axis(self) -> np.ndarray:
        """A point (x, y, z) of the rotation axis: the centre of the sources' circle, or the origin."""
        return rotation_axis(self.geometry)
