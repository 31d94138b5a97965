"""How the source, or the beam, goes round the object."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tomo_polysplat.scan.geometry import Geometry

__all__ = ["Orbit", "find_orbit", "find_turns"]

# A gap between neighbouring views this many times the usual one, and this wide, is a part not scanned.
_GAP_RATIO, _GAP_RADIANS = 4.0, np.deg2rad(5.0)
# Largest sine between the detector's rows and the plane of the orbit, or its columns and the axis: 15 degrees, up to
# which errors grow by less than a tenth (spheres off the axis, 64^3, cone and parallel beams).
_TILT = 0.26
# Largest sine between parallel rays and that plane: 5 degrees, at which errors grow by a quarter, and runs are better
# than from SIRT (bone of 26^3: 25.05 for 24.72 dB; of 3 degrees 24.87 for 24.54). At 15 they double.
_BEAM = 0.0873
# Largest relative deviation of the sources from a circle.
_ROUND = 0.02


@dataclass(frozen=True, eq=False)
class Orbit:
    """A circular orbit about an axis parallel to z.

    Attributes
    ----------
    axis : (2,) float64
        Position ``(x, y)`` of the axis.
    radius : float
        Distance of the source from it; infinite for a parallel beam.
    start : float
        Angle of the first view when going anticlockwise, radians.
    angles : (views,) float64
        Angle of the source about the axis (cone) or of the direction of the rays (parallel), from ``start``.
    steps : (views,) float64
        Part of the arc that each view stands for, radians.
    arc : float
        Radians covered: ``2 pi`` for a full turn, less for a part of one; a parallel beam that covers half a
        turn in any order counts as ``pi``.
    """

    axis: np.ndarray
    radius: float
    start: float
    angles: np.ndarray
    steps: np.ndarray
    arc: float

    @property
    def full(self) -> bool:
        """True if every ray was measured from both of its ends."""
        return self.arc == 2 * np.pi


def find_orbit(geometry: Geometry) -> tuple[Orbit | None, str]:
    """The circular orbit of a scan, or None and what is not circular about it."""
    orbit, reason = find_turns(geometry)
    if (
        orbit is not None
        and geometry.beam != "parallel"
        and np.ptp(geometry.origin[:, 2]) >= _ROUND * orbit.radius
    ):
        return None, "the source does not move on a horizontal circle"
    return orbit, reason


# A run asks a dozen times, of a few geometries.
@lru_cache(maxsize=8)
def find_turns(geometry: Geometry) -> tuple[Orbit | None, str]:
    """The circle that the source moves on as seen along the axis, at any height, or None and why there is none."""
    reason = _tilt(geometry)
    if reason:
        return None, reason
    if geometry.views < 3:
        return None, "fewer than three views"
    if geometry.beam == "parallel":
        direction = np.arctan2(geometry.origin[:, 1], geometry.origin[:, 0])
        orbit = _cover(direction, 2 * np.pi, _parallel_axis(geometry), np.inf)
        if not orbit.full:
            orbit = _cover(direction, np.pi, orbit.axis, np.inf)
        return orbit, "parallel beam about an axis"
    axis, radius = _circle(geometry.origin[:, :2])
    offset = geometry.origin[:, :2] - axis
    distance = np.hypot(offset[:, 0], offset[:, 1])
    if not np.abs(distance - radius).max() < _ROUND * radius:
        return None, "the source does not move on a horizontal circle"
    # From the source, not from the axis: a detector scaled to the axis (a virtual one) is as good.
    if not (np.einsum("vk,vk->v", offset, (geometry.centre - geometry.origin)[:, :2]) < 0).all():
        return None, "the detector does not face the source across the axis"
    return _cover(np.arctan2(offset[:, 1], offset[:, 0]), 2 * np.pi, axis, radius), "circular orbit"


def _tilt(geometry: Geometry) -> str:
    """What is tilted against the axis z, if anything."""
    u, v = (step / np.linalg.norm(step, axis=1, keepdims=True) for step in (geometry.u, geometry.v))
    if (np.abs(u[:, 2]) > _TILT).any() or (np.hypot(v[:, 0], v[:, 1]) > _TILT).any():
        return "the detector is tilted against the axis of rotation"
    beam = geometry.origin / np.linalg.norm(geometry.origin, axis=1, keepdims=True)
    if geometry.beam == "parallel" and (np.abs(beam[:, 2]) > _BEAM).any():
        return "the beam is tilted against the axis of rotation"
    return ""


def _circle(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Circle through points (n, 2) by linear least squares: |p|^2 = 2 c.p + (r^2 - |c|^2)."""
    mean = points.mean(axis=0)
    local = points - mean
    system = np.column_stack([2 * local, np.ones(len(points))])
    solution, *_ = np.linalg.lstsq(system, (local**2).sum(axis=1), rcond=None)
    radius = np.sqrt(max(solution[2] + solution[0] ** 2 + solution[1] ** 2, 0.0))
    return mean + solution[:2], float(radius)


def _parallel_axis(geometry: Geometry) -> np.ndarray:
    """The point that stays at the same distance from the middle of the detector in all views."""
    direction = geometry.origin[:, :2] / np.linalg.norm(geometry.origin[:, :2], axis=1, keepdims=True)
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
    middle = np.einsum("vk,vk->v", normal, geometry.centre[:, :2])
    solution, *_ = np.linalg.lstsq(np.column_stack([normal, np.ones(len(normal))]), middle, rcond=None)
    return solution[:2]


def _cover(angles: np.ndarray, period: float, axis: np.ndarray, radius: float) -> Orbit:
    """Shares of the arc by half the gap to either neighbour, leaving out what was not scanned."""
    folded = np.mod(angles, period)
    order = np.argsort(folded, kind="stable")
    ahead = np.diff(folded[order], append=folded[order[0]] + period)
    # A high quantile rather than the median: views may come in pairs, or at the uneven golden angle.
    missing = ahead > max(_GAP_RATIO * np.quantile(ahead, 0.9), _GAP_RADIANS)
    start = folded[order[(int(np.argmax(ahead)) + 1) % len(angles)]] if missing.any() else folded[order[0]]
    covered = np.where(missing, 0.0, ahead)
    steps = np.empty_like(folded)
    steps[order] = 0.5 * (covered + np.roll(covered, 1))
    arc = period - ahead[missing].sum() if missing.any() else period
    return Orbit(axis, radius, float(start), np.mod(folded - start, period), steps, float(arc))
