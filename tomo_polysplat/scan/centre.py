"""Where the rotation axis of a parallel-beam scan falls on the detector, found from the data."""

from __future__ import annotations

import logging
from typing import NamedTuple

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_shape
from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.parallel import run_tasks
from tomo_polysplat.scan.assumptions import Located, compare, locate

__all__ = ["chosen_rows", "estimate_centre", "find_centre"]

logger = logging.getLogger(__name__)

# A mirrored pair must share this part of the detector's width: the axis may be 4 % of it from either edge.
SMALLEST_OVERLAP = 0.08
# Detector rows that are looked at, and lines (rows times pairs of views); parts that tell the noise.
_MOST_ROWS, _MOST_LINES, _PARTS = 128, 2048, 16
# Rows transformed together: few enough to stay in cache.
_ROWS_AT_ONCE = 8
# Radians by which one angle is the same as another.
_SAME = 1e-6


def estimate_centre(projections: np.ndarray, angles: np.ndarray, valid: np.ndarray | None = None) -> float:
    """Column of the rotation axis: that of :func:`find_centre`, with a warning in the log where it is uncertain."""
    found = find_centre(projections, angles, valid)
    columns = np.shape(projections)[2]
    logger.info(
        "rotation axis estimated at column %.2f of %d (mismatch %.3g)", found.place, columns, found.mismatch
    )
    if found.doubt:
        logger.warning("the rotation axis is uncertain: %s; give centre= in columns", found.doubt)
    return found.place


def find_centre(projections: np.ndarray, angles: np.ndarray, valid: np.ndarray | None = None) -> Located:
    """The rotation axis, from views half a turn apart being mirror images of each other.

    Parameters
    ----------
    projections : array, shape (rows, views, columns)
        Line integrals of a parallel beam.
    angles : array, shape (views,)
        View angles in radians, at least half a turn (one step may be missing).
    valid : bool array, shape of `projections`, or None
        Rays to use; None means those that are finite.

    Returns
    -------
    Located
        In columns counted from the detector's edge, as in TomoPy: ``columns / 2`` is the middle.

    Raises
    ------
    ValueError
        If no two views are half a turn apart, or they show nothing.

    Notes
    -----
    The axis at column index c (of pixel centres) maps column j of a view onto ``2 c - j`` of its opposite.
    For every whole 2 c the two are compared where they overlap and both rays are to be used,
    ``sum (a - b)^2 / sum ((a - mean a)^2 + (b - mean b)^2)``, and the smallest value is refined by a parabola. Noise
    alone gives 1, however narrow the overlap. Written out, the sums are convolutions of a view with its opposite,
    which Fourier transforms give for all 2 c at once.
    """
    projections = require_array("projections", projections, 3)
    angles = require_array("angles", angles, 1).astype(np.float64)
    require_shape("angles", angles, (projections.shape[1],), "(views,)")
    if valid is not None:
        require_shape("valid", valid, projections.shape, "(rows, views, columns)")
    rows, _, columns = projections.shape
    chosen = chosen_rows(rows)
    pairs = _opposite_views(angles, max(_PARTS, _MOST_LINES // len(chosen) // 16))
    smallest = max(3, int(SMALLEST_OVERLAP * columns))
    sums = np.arange(smallest - 1, 2 * columns - 1 - smallest)
    differences, variances, samples = _mismatches(projections, valid, chosen, pairs)
    found = compare(differences[:, sums], variances[:, sums], samples[sums])
    if found is None:
        raise fail(
            "projections", "an object in the beam", "views without contrast", "give centre= in columns"
        )
    return locate(found, (sums + 1) / 2)


def chosen_rows(rows: int) -> np.ndarray:
    """Those of so many rows that `find_centre` looks at."""
    return evenly_spread(rows, _MOST_ROWS)


class _Pairs(NamedTuple):
    """Views, and the two between which the view half a turn later lies, with the share of the second, (pairs,)."""

    view: np.ndarray
    first: np.ndarray
    second: np.ndarray
    share: np.ndarray

    def part(self, begin: int, end: int) -> _Pairs:
        return _Pairs(*(values[begin:end] for values in self))


def _opposite_views(angles: np.ndarray, most: int) -> _Pairs:
    """Up to `most` views and, for each, the view half a turn later, interpolated between measured ones.

    A scan over 0 to 180 degrees that leaves the last angle out has no exact pair: the missing view is then
    extrapolated from the two nearest, by at most one step.
    """
    gaps = np.diff(np.sort(np.mod(angles, 2 * np.pi)))
    # An angle may be there more than once.
    gaps = gaps[gaps > _SAME]
    step = float(np.median(gaps)) if len(gaps) > 1 else 0.0
    found = []
    for view in range(len(angles)):
        away = np.angle(np.exp(1j * (angles - angles[view] - np.pi)))
        near = np.argsort(np.abs(away))
        first = near[0]
        others = near[np.abs(away[near] - away[first]) > _SAME]
        if abs(away[first]) < _SAME:
            found.append((view, first, first, 0.0))
        elif abs(away[first]) <= 1.01 * step and len(others):
            second = others[0]
            found.append((view, first, second, away[first] / (away[first] - away[second])))
    if not found:
        raise fail(
            "angles",
            "two views half a turn apart",
            f"{np.ptp(np.rad2deg(angles)):.1f} degrees in {len(angles)} views",
            "give centre= in columns",
        )
    return _Pairs(*map(np.array, zip(*(found[k] for k in evenly_spread(len(found), most)))))


def _mismatches(
    projections: np.ndarray, valid: np.ndarray | None, rows: np.ndarray, pairs: _Pairs
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Squared differences and variances (parts, sums), and samples (sums,), for every ``column + mirrored column``."""
    from scipy.fft import next_fast_len

    columns = projections.shape[2]
    length = next_fast_len(2 * columns - 1, real=True)
    at_once = -(-len(pairs.view) // _PARTS)
    tasks = [
        (rows[a : a + _ROWS_AT_ONCE], pairs.part(b, b + at_once))
        for b in range(0, len(pairs.view), at_once)
        for a in range(0, len(rows), _ROWS_AT_ONCE)
    ]

    def part(some: np.ndarray, opposite: _Pairs) -> np.ndarray:
        return _sums(projections, valid, some, opposite, length)[:, : 2 * columns - 1]

    parts = np.zeros((min(_PARTS, len(tasks)), 3, 2 * columns - 1))
    for begin in range(0, len(tasks), _PARTS):
        for number, found in enumerate(run_tasks(part, tasks[begin : begin + _PARTS])):
            parts[number] += found
    return parts[:, 0], parts[:, 1], parts[:, 2].sum(axis=0)


def _sums(
    projections: np.ndarray, valid: np.ndarray | None, rows: np.ndarray, pairs: _Pairs, length: int
) -> np.ndarray:
    """Squared differences, variances and samples of some rows and pairs, (3, sums)."""
    from scipy.fft import irfft, rfft

    def taken(views: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values = projections[rows[:, None], views].astype(np.float64)
        usable = np.isfinite(values) if valid is None else np.isfinite(values) & valid[rows[:, None], views]
        return np.where(usable, values, 0), usable

    a, use_a = taken(pairs.view)
    (first, use_first), (second, use_second) = taken(pairs.first), taken(pairs.second)
    use_b = use_first & use_second
    share = pairs.share[None, :, None]
    b = np.where(use_b, (1 - share) * first + share * second, 0)
    # About the middle of the two, for the sake of rounding.
    level = 0.5 * (_mean(a, use_a) + _mean(b, use_b))
    a, b = np.where(use_a, a - level, 0), np.where(use_b, b - level, 0)
    weight_a, weight_b = rfft(use_a.astype(np.float64), length), rfft(use_b.astype(np.float64), length)
    ones = np.round(irfft(weight_a * weight_b, length))
    count = np.maximum(ones, 1)
    fa, fb = rfft(a, length), rfft(b, length)
    squares = irfft(rfft(a * a, length) * weight_b + weight_a * rfft(b * b, length), length)
    mean_a, mean_b = irfft(fa * weight_b, length) / count, irfft(weight_a * fb, length) / count
    differences = squares - 2 * irfft(fa * fb, length)
    variances = squares - count * (mean_a**2 + mean_b**2)
    summed = np.stack([differences, variances, ones])
    return np.where(ones > 1, summed, 0).sum(axis=(1, 2))


def _mean(line: np.ndarray, use: np.ndarray) -> np.ndarray:
    return line.sum(axis=2, keepdims=True) / np.maximum(use.sum(axis=2, keepdims=True), 1)
