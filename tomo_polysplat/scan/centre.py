"""Where the rotation axis of a parallel-beam scan falls on the detector, found from the data."""

from __future__ import annotations

import logging
from typing import NamedTuple

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_shape
from tomo_polysplat.parallel import run_tasks, split_range

__all__ = ["estimate_centre"]

logger = logging.getLogger(__name__)

# A view and its mirror image must overlap by this share of the detector's width; in less noise alone may agree.
SMALLEST_OVERLAP = 0.3
# Rows transformed together: few enough to stay in cache.
_ROWS_AT_ONCE = 8
# Rounding errors, as a share of the largest sum of squares.
_ROUNDING = 1e-10


def estimate_centre(projections: np.ndarray, angles: np.ndarray, valid: np.ndarray | None = None) -> float:
    """Column of the rotation axis, from views half a turn apart being mirror images of each other.

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
    float
        Position in columns counted from the detector's edge, as in TomoPy: ``columns / 2`` is the middle.

    Raises
    ------
    ValueError
        If no two views are half a turn apart, or they show nothing.

    Notes
    -----
    The axis at column index c (of pixel centres) maps column j of a view onto ``2 c - j`` of its opposite.
    For every whole 2 c the two are compared where they overlap and both rays are to be used,
    ``sum (a - b)^2 / sum (a^2 + b^2)``, and the smallest value is refined by a parabola. Written out, the sums
    are convolutions of a view with its opposite, which Fourier transforms give for all 2 c at once.
    """
    projections = require_array("projections", projections, 3)
    angles = require_array("angles", angles, 1).astype(np.float64)
    require_shape("angles", angles, (projections.shape[1],), "(views,)")
    if valid is not None:
        require_shape("valid", valid, projections.shape, "(rows, views, columns)")
    pairs = _opposite_views(angles)
    columns = projections.shape[2]
    smallest = max(3, int(SMALLEST_OVERLAP * columns))
    sums = np.arange(smallest - 1, 2 * columns - 1 - smallest)
    scores = _mismatches(projections, valid, pairs)[sums]
    if not np.isfinite(scores).any():
        raise fail(
            "projections", "an object in the beam", "views without contrast", "give centre= in columns"
        )
    best = int(np.nanargmin(scores))
    centre = (sums[best] + _parabola_offset(scores, best)) / 2 + 0.5
    logger.info("rotation axis estimated at column %.2f of %d (mismatch %.3g)", centre, columns, scores[best])
    return float(centre)


class _Pairs(NamedTuple):
    """Views, and the two between which the view half a turn later lies, with the share of the second, (pairs,)."""

    view: np.ndarray
    first: np.ndarray
    second: np.ndarray
    share: np.ndarray


def _opposite_views(angles: np.ndarray, most: int = 16) -> _Pairs:
    """Up to `most` views and, for each, the view half a turn later, interpolated between measured ones.

    A scan over 0 to 180 degrees that leaves the last angle out has no exact pair: the missing view is then
    extrapolated from the two nearest, by at most one step.
    """
    ordered = np.sort(np.mod(angles, 2 * np.pi))
    step = float(np.median(np.diff(ordered))) if len(ordered) > 2 else 0.0
    found = []
    for view in range(len(angles)):
        away = np.angle(np.exp(1j * (angles - angles[view] - np.pi)))
        first, second = np.argsort(np.abs(away))[:2]
        if abs(away[first]) < 1e-6:
            found.append((view, first, first, 0.0))
        elif abs(away[first]) <= 1.01 * step and away[second] != away[first]:
            found.append((view, first, second, away[first] / (away[first] - away[second])))
    if not found:
        raise fail(
            "angles",
            "two views half a turn apart",
            f"{np.ptp(np.rad2deg(angles)):.1f} degrees in {len(angles)} views",
            "give centre= in columns",
        )
    keep = np.linspace(0, len(found) - 1, min(most, len(found))).round().astype(int)
    return _Pairs(*map(np.array, zip(*(found[k] for k in keep))))


def _mismatches(projections: np.ndarray, valid: np.ndarray | None, pairs: _Pairs) -> np.ndarray:
    """Relative squared differences where ``column + mirrored column`` is 0, 1, ..., NaN where there is nothing."""
    from scipy.fft import irfft, next_fast_len

    columns = projections.shape[2]
    length = next_fast_len(2 * columns - 1, real=True)
    blocks = split_range(len(projections), -(-len(projections) // _ROWS_AT_ONCE))

    def part(a: int, b: int) -> np.ndarray:
        return _spectra(projections[a:b], None if valid is None else valid[a:b], pairs, length)

    energy, product = irfft(np.sum(run_tasks(part, blocks), axis=0), length)[:, : 2 * columns - 1]
    # Where a row holds nothing the transforms leave rounding errors.
    something = energy > _ROUNDING * energy.max()
    return np.where(something, 1 - 2 * product / np.where(something, energy, 1), np.nan)


def _spectra(projections: np.ndarray, valid: np.ndarray | None, pairs: _Pairs, length: int) -> np.ndarray:
    """Transforms of ``sum (a^2 + b^2)`` and ``sum a b`` over some rows, (2, frequencies)."""
    from scipy.fft import rfft

    def taken(views: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values = projections[:, views].astype(np.float64)
        usable = np.isfinite(values) if valid is None else np.isfinite(values) & (valid[:, views] > 0)
        return np.where(usable, values, 0), usable

    a, use_a = taken(pairs.view)
    (first, use_first), (second, use_second) = taken(pairs.first), taken(pairs.second)
    use_b = use_first & use_second
    share = pairs.share[None, :, None]
    b = np.where(use_b, (1 - share) * first + share * second, 0)
    weight_a, weight_b = (rfft(use.astype(np.float64), length) for use in (use_a, use_b))
    energy = rfft(a * a, length) * weight_b + weight_a * rfft(b * b, length)
    product = rfft(a, length) * rfft(b, length)
    return np.stack([energy.sum(axis=(0, 1)), product.sum(axis=(0, 1))])


def _parabola_offset(scores: np.ndarray, best: int) -> float:
    """Position of the minimum of the parabola through three scores, relative to the middle one."""
    if not 0 < best < len(scores) - 1:
        return 0.0
    left, middle, right = scores[best - 1 : best + 2]
    curvature = left - 2 * middle + right
    return float(0.5 * (left - right) / curvature) if curvature > 0 else 0.0
