"""The plane of the orbit of a cone or fan beam: rays and the rays that ran the same way backwards."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.scan.defects import fill_invalid
from tomo_polysplat.scan.evidence import Comparison, Located, compare, locate
from tomo_polysplat.scan.probes.measured import Measured
from tomo_polysplat.scan.view_geometry import Geometry

__all__ = ["Fan"]

# Half the range of offsets that is searched, as a share of the columns; views compared; columns smoothed over.
_RANGE, _MOST_VIEWS, _SMOOTH = 0.12, 60, 1.0
_FEWEST_VIEWS = 24
# Relative change of the source's distance from the axis that still is a circle.
_ROUND = 0.02
# A parabola is laid through places so far apart, in columns.
_FINE = np.linspace(-1, 1, 9)
# Share of the columns that must have been measured from both ends.
_SMALLEST_OVERLAP = 0.08
# Columns compared at most.
_MOST_COLUMNS = 512


class Fan:
    """The plane of the orbit: a fan of rays per view, as a function of azimuth and column."""

    def __init__(self, measured: Measured) -> None:
        geometry = measured.geometry
        arm = (geometry.origin - measured.axis)[:, :2]
        distance = np.hypot(*arm.T)
        height = np.ptp(geometry.origin[:, 2])
        if (
            geometry.views < _FEWEST_VIEWS
            or np.ptp(distance) > _ROUND * distance.mean()
            or height > _ROUND * distance.mean()
        ):
            raise ValueError("the source does not go round on a circle, or in too few views")
        at_source = geometry.origin + (measured.axis - geometry.origin) * [1, 1, 0]
        foot = _foot(geometry, at_source)
        if np.ptp(foot[:, 0]) > 1 or np.ptp(foot[:, 1]) > 1:
            raise ValueError("the detector moves against the source")
        self.axis_column, row = np.median(foot, axis=0)
        if not -0.5 <= row <= geometry.rows - 0.5:
            raise ValueError("the plane of the orbit is not on the detector")
        self.slope = self._fan_slope(geometry, arm)
        order = np.argsort(measured.azimuth, kind="stable")
        self.azimuth = measured.azimuth[order]
        self.values = self._plane(measured, float(np.clip(row, 0, geometry.rows - 1)))[order]
        gaps = np.diff(self.azimuth, append=self.azimuth[0] + 2 * np.pi)
        self.largest_gap = 2.5 * float(np.median(gaps))
        columns = self.values.shape[1]
        self.columns = np.arange(0, columns, -(-columns // _MOST_COLUMNS))
        self.sources = np.unique(np.linspace(0, len(order) - 1, min(len(order), _MOST_VIEWS)).astype(int))

    def _fan_slope(self, geometry: Geometry, arm: np.ndarray) -> float:
        """Change of the tangent of the fan angle, anticlockwise, per column."""
        ahead = -arm / np.hypot(*arm.T)[:, None]
        left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
        pixel = geometry.corner + self.axis_column * geometry.u - geometry.origin
        depth = np.einsum("vk,vk->v", pixel[:, :2], ahead)
        return float(np.median(np.einsum("vk,vk->v", geometry.u[:, :2], left) / depth))

    @staticmethod
    def _plane(measured: Measured, row: float) -> np.ndarray:
        """Projections in the plane of the orbit, (views, columns), bad rays filled, slightly smoothed."""
        from scipy.ndimage import gaussian_filter1d

        low = int(row)
        rows = slice(low, min(low + 2, measured.scan.rows))
        pair = fill_invalid(measured.scan.projections[rows], measured.valid[rows])
        plane = pair[0] if len(pair) == 1 else (1 - (row - low)) * pair[0] + (row - low) * pair[1]
        return gaussian_filter1d(plane.astype(np.float64), _SMOOTH, axis=1)

    def locate(self, direction: int) -> Located:
        """By how many columns the axis is off where the angles go round in `direction`, +1 as told or -1."""
        columns = self.values.shape[1]
        reach = int(np.ceil(_RANGE * columns))
        whole = np.arange(-reach, reach + 1.0)
        coarse = self._compare(whole, direction)
        if coarse is None:
            raise ValueError("no ray was measured from both ends")
        rough = locate(coarse, whole)
        fine = whole[coarse.best] + _FINE
        found = self._compare(fine, direction)
        if found is None:
            return rough
        place, each = _vertex(fine, found.mismatch), [_vertex(fine, line) for line in found.without]
        error = float(np.std(each) * np.sqrt(len(each) - 1)) if each else 0.0
        mismatch = max(float(np.nanmin(found.mismatch)), 1e-12)
        return Located(place, max(rough.uncertainty, error), mismatch, rough.doubt)

    def direction_doubt(self, told: float, turned: float) -> float:
        """Standard errors by which angles as told explain the rays better than turned ones, each at its offset."""
        parts = [self._sums(offset, sign) for offset, sign in ((told, +1), (turned, -1))]
        differences, variances, samples = (np.stack(one, axis=-1) for one in zip(*parts))
        found = compare(differences, variances, samples.sum(axis=0))
        if found is None:
            return 0.0
        return float(found.doubt[1] - found.doubt[0])

    def _compare(self, offsets: np.ndarray, direction: int) -> Comparison | None:
        parts = [self._sums(offset, direction) for offset in offsets]
        differences, variances, samples = (np.stack(one, axis=-1) for one in zip(*parts))
        samples = samples.sum(axis=0)
        enough = samples > _SMALLEST_OVERLAP * len(self.sources) * len(self.columns)
        return compare(np.where(enough, differences, 0), np.where(enough, variances, 0), samples)

    def _sums(self, offset: float, direction: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Squared differences between rays and their opposites, squares about the means, and pairs, per source."""
        column = self.columns
        fan = np.arctan(self.slope * (column - self.axis_column - offset))
        there = self.azimuth[self.sources, None] + np.pi + direction * 2 * fan
        mirrored = np.broadcast_to(2 * (self.axis_column + offset) - column, there.shape)
        opposite = self._at(np.mod(there + np.pi, 2 * np.pi) - np.pi, mirrored)
        both = np.isfinite(opposite)
        count = both.sum(axis=1)
        own, opposite = (
            np.where(both, values, 0) for values in (self.values[self.sources][:, column], opposite)
        )
        squares = sum(
            (values**2).sum(axis=1) - values.sum(axis=1) ** 2 / np.maximum(count, 1)
            for values in (own, opposite)
        )
        return ((own - opposite) ** 2).sum(axis=1), squares, count

    def _at(self, azimuth: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Values between views and columns; NaN where there are none on both sides."""
        count, columns = self.values.shape
        after = np.searchsorted(self.azimuth, azimuth)
        first, second = (after - 1) % count, after % count
        gap = np.mod(self.azimuth[second] - self.azimuth[first], 2 * np.pi)
        share = np.mod(azimuth - self.azimuth[first], 2 * np.pi) / np.where(gap > 0, gap, 1)
        left = np.floor(column).astype(int)
        inside = (left >= 0) & (left < columns - 1) & (gap <= self.largest_gap) & (gap > 0)
        left = np.clip(left, 0, columns - 2)
        part = column - left
        a, b = ((1 - part) * self.values[v, left] + part * self.values[v, left + 1] for v in (first, second))
        return np.where(inside, (1 - share) * a + share * b, np.nan)


def _foot(geometry: Geometry, points: np.ndarray) -> np.ndarray:
    """Detector coordinates (views, 2) of one point per view."""
    inverse, reference = geometry.projection_matrices()
    local = np.einsum("vkl,vl->vk", inverse, points - reference)
    return local[:, :2] / local[:, 2:]


def _vertex(places: np.ndarray, mismatch: np.ndarray) -> float:
    """Where the parabola through mismatches is lowest, within the places."""
    bend, tilt, _ = np.polyfit(places - places.mean(), mismatch, 2)
    reach = 0.5 * float(np.ptp(places))
    return float(places.mean() + (np.clip(-0.5 * tilt / bend, -reach, reach) if bend > 0 else 0.0))
