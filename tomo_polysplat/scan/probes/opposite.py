"""Do rays that were measured from both ends agree: where is the axis, and which way round did the scan go?

The ray from a source at azimuth b that leaves at the angle g from the axis is met again, backwards, from the
azimuth b + pi + 2 g at the angle -g. If the detector is off by some columns, or the angles run the other way
(b + pi - 2 g), the two do not agree. In a parallel beam g is zero, and turning the angles round gives the mirror
image of the object, which agrees as well as the object itself.
"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.scan.centre import estimate_centre
from tomo_polysplat.scan.defects import fill_invalid
from tomo_polysplat.scan.probes.measured import Finding, Measured

__all__ = ["CENTRE", "DIRECTION", "probe_centre_and_direction"]

# Columns off from which it is a defect.
_TOLERATED = 0.5
# The other direction must fit this many times better.
_MUCH_BETTER = 2.0
# Half the range of offsets that is searched, as a share of the columns; views compared; columns smoothed over.
_RANGE, _MOST_VIEWS, _SMOOTH = 0.12, 60, 1.0
# Relative change of the source's distance from the axis that still is a circle.
_ROUND = 0.02

CENTRE, DIRECTION = "centre", "direction of the angles"


def probe_centre_and_direction(measured: Measured) -> list[Finding]:
    """Compare rays with those that ran the same way backwards."""
    if measured.geometry.beam == "parallel":
        text = "a parallel beam cannot tell: turned angles give the mirror image of the object"
        return [_parallel_centre(measured), Finding(DIRECTION, "unknown", text)]
    try:
        fan = _Fan(measured)
    except ValueError as error:
        return [Finding(name, "unknown", str(error)) for name in (CENTRE, DIRECTION)]
    offset, mismatch = fan.best_offset(+1)
    turned_offset, turned = fan.best_offset(-1)
    numbers = {
        "offset": offset,
        "mismatch": mismatch,
        "turned_offset": turned_offset,
        "turned_mismatch": turned,
    }
    if mismatch > _MUCH_BETTER * turned:
        text = f"opposite rays agree {mismatch / turned:.1f} times better with the angles turned round"
        found = Finding(DIRECTION, "defect", text, "take the angles times -1 (or reverse the views)", numbers)
        return [_centre(turned_offset, numbers), found]
    return [_centre(offset, numbers), _direction(mismatch, turned, numbers)]


def _direction(mismatch: float, turned: float, numbers: dict[str, float]) -> Finding:
    if turned < _MUCH_BETTER * mismatch:
        text = "opposite rays agree about as well with the angles turned round"
        return Finding(DIRECTION, "unknown", text, "", numbers)
    return Finding(
        DIRECTION, "ok", f"opposite rays agree {turned / mismatch:.1f} times better than turned", "", numbers
    )


def _centre(offset: float, numbers: dict[str, float]) -> Finding:
    """`offset` is where the axis is in the data, counted from where the geometry says, in columns."""
    if abs(offset) <= _TOLERATED:
        return Finding(
            CENTRE, "ok", f"within {abs(offset):.2f} columns of where the geometry has it", "", numbers
        )
    side = "above" if offset > 0 else "below"
    text = f"the rotation axis falls {abs(offset):.2f} columns {side} where the geometry has it"
    remedy = f"move the detector: astra.geom_postalignment(proj_geom, ({-offset:.2f}, 0.0))"
    return Finding(CENTRE, "defect", text, remedy, numbers)


def _parallel_centre(measured: Measured) -> Finding:
    geometry = measured.geometry
    stated = geometry.project_points(np.zeros((1, 3)))[:, 0, 0] + 0.5
    if np.ptp(stated) > _TOLERATED:
        return Finding(CENTRE, "unknown", "the axis moves on the detector")
    try:
        found = estimate_centre(measured.filled, measured.azimuth)
    except ValueError as error:
        return Finding(CENTRE, "unknown", str(error))
    return _centre(found - float(np.median(stated)), {"stated": float(np.median(stated)), "found": found})


class _Fan:
    """The plane of the orbit: a fan of rays per view, as a function of azimuth and column."""

    def __init__(self, measured: Measured) -> None:
        geometry = measured.geometry
        arm = (geometry.origin - measured.axis)[:, :2]
        distance = np.hypot(*arm.T)
        height = np.ptp(geometry.origin[:, 2])
        if (
            geometry.views < 24
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
        self.sources = np.unique(np.linspace(0, len(order) - 1, min(len(order), _MOST_VIEWS)).astype(int))

    def _fan_slope(self, geometry, arm: np.ndarray) -> float:
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

    def best_offset(self, direction: int) -> tuple[float, float]:
        """Columns by which the axis is off, and the relative mismatch there."""
        columns = self.values.shape[1]
        offsets = np.arange(-np.ceil(_RANGE * columns), np.ceil(_RANGE * columns) + 1)
        scores = np.array([self._mismatch(offset, direction) for offset in offsets])
        if not np.isfinite(scores).any():
            raise ValueError("no ray was measured from both ends")
        centre = offsets[int(np.nanargmin(scores))]
        offsets = centre + np.linspace(-1, 1, 9)
        scores = np.array([self._mismatch(offset, direction) for offset in offsets])
        bend, tilt, _ = np.polyfit(offsets - centre, scores, 2)
        best = centre + (np.clip(-0.5 * tilt / bend, -1, 1) if bend > 0 else 0.0)
        return float(best), max(self._mismatch(best, direction), 1e-12)

    def _mismatch(self, offset: float, direction: int) -> float:
        """Squared difference between rays and their opposites, relative to their squares."""
        column = np.arange(self.values.shape[1])
        fan = np.arctan(self.slope * (column - self.axis_column - offset))
        there = self.azimuth[self.sources, None] + np.pi + direction * 2 * fan
        mirrored = np.broadcast_to(2 * (self.axis_column + offset) - column, there.shape)
        opposite = self._at(np.mod(there + np.pi, 2 * np.pi) - np.pi, mirrored)
        own = self.values[self.sources]
        both = np.isfinite(opposite)
        energy = np.sum((own**2 + opposite**2)[both]) if both.mean() > 0.1 else 0.0
        return float(np.sum((own - opposite)[both] ** 2) / energy) if energy > 0 else np.nan

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


def _foot(geometry, points: np.ndarray) -> np.ndarray:
    """Detector coordinates (views, 2) of one point per view."""
    inverse, reference = geometry.projection_matrices()
    local = np.einsum("vkl,vl->vk", inverse, points - reference)
    return local[:, :2] / local[:, 2:]
