"""Where the rotation axis of a parallel-beam scan falls on the detector, found from the data."""

from __future__ import annotations

import logging

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_shape

__all__ = ["estimate_centre"]

logger = logging.getLogger(__name__)

# A mirrored pair must share this part of the detector's width, or noise alone could look alike.
SMALLEST_OVERLAP = 0.3


def estimate_centre(projections: np.ndarray, angles: np.ndarray, valid: np.ndarray | None = None) -> float:
    """Column of the rotation axis, from views half a turn apart being mirror images of each other.

    Parameters
    ----------
    projections : array, shape (rows, views, columns)
        Line integrals of a parallel beam.
    angles : array, shape (views,)
        View angles in radians, at least half a turn (one step may be missing).
    valid : bool array like `projections`, or None
        Rays to use.

    Returns
    -------
    float
        Position in columns counted from the detector's edge, as in TomoPy: ``columns / 2`` is the middle.

    Raises
    ------
    ValueError
        If no two views are half a turn apart.

    Notes
    -----
    The axis at column index c (of pixel centres) maps column j of a view onto ``2 c - j`` of its opposite.
    For every whole 2 c the two are compared where they overlap,
    ``sum (a - b)^2 / sum (a^2 + b^2)``, and the smallest value is refined by a parabola.
    """
    projections = require_array("projections", projections, 3)
    angles = require_array("angles", angles, 1).astype(np.float64)
    require_shape("angles", angles, (projections.shape[1],), "(views,)")
    views, opposite = _opposite_views(projections, angles)
    usable = np.ones(views.shape, bool)
    if valid is not None:
        usable = np.broadcast_to(valid.all(axis=(0, 1)), views.shape)
    columns = projections.shape[2]
    smallest = max(3, int(SMALLEST_OVERLAP * columns))
    sums = np.arange(smallest - 1, 2 * columns - 1 - smallest)
    scores = np.array([_mismatch(views, opposite, usable, int(s)) for s in sums])
    if not np.isfinite(scores).any():
        raise fail(
            "projections", "an object in the beam", "views without contrast", "give centre= in columns"
        )
    best = int(np.nanargmin(scores))
    centre = (sums[best] + _parabola_offset(scores, best)) / 2 + 0.5
    logger.info("rotation axis estimated at column %.2f of %d (mismatch %.3g)", centre, columns, scores[best])
    return float(centre)


def _opposite_views(
    projections: np.ndarray, angles: np.ndarray, most: int = 16
) -> tuple[np.ndarray, np.ndarray]:
    """Up to `most` views and, for each, the view half a turn later, interpolated between measured ones.

    A scan over 0 to 180 degrees that leaves the last angle out has no exact pair: the missing view is then
    extrapolated from the two nearest, by at most one step.
    """
    ordered = np.sort(np.mod(angles, 2 * np.pi))
    step = float(np.median(np.diff(ordered))) if len(ordered) > 2 else 0.0
    chosen, opposite = [], []
    for view in range(len(angles)):
        away = np.angle(np.exp(1j * (angles - angles[view] - np.pi)))
        first, second = np.argsort(np.abs(away))[:2]
        if abs(away[first]) < 1e-6:
            opposite.append(projections[:, first])
        elif abs(away[first]) <= 1.01 * step and away[second] != away[first]:
            weight = away[first] / (away[first] - away[second])
            opposite.append((1 - weight) * projections[:, first] + weight * projections[:, second])
        else:
            continue
        chosen.append(view)
    if not chosen:
        raise fail(
            "angles",
            "two views half a turn apart",
            f"{np.ptp(np.rad2deg(angles)):.1f} degrees in {len(angles)} views",
            "give centre= in columns",
        )
    keep = np.linspace(0, len(chosen) - 1, min(most, len(chosen))).round().astype(int)
    views = projections[:, [chosen[k] for k in keep]]
    return views.astype(np.float64), np.stack([opposite[k] for k in keep], axis=1).astype(np.float64)


def _mismatch(views: np.ndarray, opposite: np.ndarray, usable: np.ndarray, total: int) -> float:
    """Relative squared difference over the columns where ``column + mirrored column = total``."""
    columns = views.shape[-1]
    low, high = max(0, total - columns + 1), min(columns - 1, total)
    straight = slice(low, high + 1)
    a, b = views[..., straight], opposite[..., straight][..., ::-1]
    both = usable[..., straight] & usable[..., straight][..., ::-1]
    energy = np.sum((a * a + b * b)[both])
    return float(np.sum(np.square(a - b)[both]) / energy) if energy > 0 else np.nan


def _parabola_offset(scores: np.ndarray, best: int) -> float:
    """Position of the minimum of the parabola through three scores, relative to the middle one."""
    if not 0 < best < len(scores) - 1:
        return 0.0
    left, middle, right = scores[best - 1 : best + 2]
    curvature = left - 2 * middle + right
    return float(0.5 * (left - right) / curvature) if curvature > 0 else 0.0
