"""Rays at the lower end of the scale: a saturated camera has replaced what is brighter by one value.

The value of such a ray is no measurement, but a bound: there is at least so much light. Where the open field was not
saturated the bound lies above 0, and rays well inside of such an area pass beside the object. Rays that are known to be
saturated, as they reach the ``saturation`` that a user names, are minus infinity.
"""

from __future__ import annotations

import logging

import numpy as np

from tomo_polysplat.scan.extremes import least

__all__ = ["lower_end", "mend_light_end"]

logger = logging.getLogger(__name__)

# Air of pictures without noise is 0 but for rounding.
_ROUNDED = 1e-3
# So many rays, and such a share of all, are at the end at least.
_FEWEST, _SHARE = 10, 2e-4
# Of these, the share that has no other neighbours. Noise cut off at the mean of air, as by ``numpy.maximum``, leaves
# 2^-9 of them, and a cut at one standard deviation, which does no harm, a quarter.
_INSIDE = 0.5
# Of the least that pixels have measured where they were not saturated, what tells the end that all have in common.
_LOW = 0.25
# Share of the border whose edge lies no farther out than what is left out: a pixel more costs an implant of 24^3 voxels
# 3 dB, a pixel less powder 1 dB.
_WIDE = 0.75


def mend_light_end(values: np.ndarray) -> tuple[int, int]:
    """Say that a camera was saturated, whose open field was not; let rays in such areas pass beside the object.

    Parameters
    ----------
    values : (views, rows, columns) float32 array
        -log(I/I0), changed in place; NaN where a ray is not to be used, minus infinity where it is known to be
        saturated. Saturated rays become 0, and those at the border, which may pass through thin matter, NaN. Where
        there is no such area, minus infinity becomes NaN.

    Returns
    -------
    saturated, told : int
        Saturated rays, and those of them that were minus infinity.
    """
    low = least(values)
    end = lower_end(values, low)
    if end is None:
        for view in values if low == -np.inf else ():
            view[np.isneginf(view)] = np.nan
        return 0, 0
    wide, many, left_out = _width(values, end), 0, 0
    # View by view: a mark for every ray would be a quarter of all that the rays take.
    for view in values:
        saturated = view == end
        near = saturated & _within(~saturated & ~np.isnan(view), wide)
        view[saturated], view[near] = 0.0, np.nan
        many, left_out = many + int(np.count_nonzero(saturated)), left_out + int(np.count_nonzero(near))
    told = end == -np.inf
    share = f"{100 * many / values.size:.2g} % of the rays "
    share += "are saturated" if told else f"hold the same value, the least of all, {end:.3g}"
    words = f"they are taken to pass beside the object, but for {left_out} at the border, which are left out"
    remedy = "measure with less light; where that cannot be, with an open field that is not saturated"
    because = "" if told else ": the detector was saturated there"
    logger.warning("%s%s; %s: %s.", share, because, words, remedy)
    return many, many if told else 0


def lower_end(values: np.ndarray, low: float | None = None) -> float | None:
    """What rays (views, rows, columns) at the lower end of the scale hold; None where there is no end above air.

    Of an open field that was saturated, too, air holds 0. So it does without noise, and that is no end: `check` asks.
    The least value need not be looked for where it is known.
    """
    low = least(values) if low is None else low
    if low == np.inf or -np.inf < low <= _ROUNDED:
        return None
    numbers = [int(np.count_nonzero(view == low)) for view in values]
    if (min(numbers) == 0 and low > 0) or sum(numbers) <= max(_FEWEST, _SHARE * values.size):
        return None
    inside = sum(int(np.count_nonzero(~_within(view != low, 1))) for view in values)
    if inside < _INSIDE * sum(numbers):
        return None
    if low > 0:
        # Grey values of air in pictures without noise are within one of the open beam.
        return low if low > least(values, above=low) - low else None
    return low if _above_air(values) else None


def _above_air(values: np.ndarray) -> bool:
    """Whether pixels that are saturated in some views measure more than air else; dead ones measure air as well."""
    ends, lowest = np.zeros(values.shape[1:], bool), np.full(values.shape[1:], np.nan, values.dtype)
    for view in values:
        marked = np.isneginf(view)
        ends |= marked
        np.fmin(lowest, np.where(marked, np.nan, view), out=lowest)
    lowest = lowest[ends & np.isfinite(lowest)]
    return len(lowest) > 0 and bool(np.quantile(lowest, _LOW) > _ROUNDED)


def _within(rays: np.ndarray, wide: int) -> np.ndarray:
    """Rays (rows, columns) no more than so many pixels from some, along rows and columns."""
    from scipy.ndimage import maximum_filter

    return maximum_filter(rays, size=2 * wide + 1, mode="nearest")


def _width(values: np.ndarray, end: float) -> int:
    """Pixels at the border that may see matter: as far as a round edge goes on from the first rays above it."""
    found = []
    for view in values:
        for one in (view, view[:, ::-1]):
            ends = one == end
            border = ends[:, :-2] & ~ends[:, 1:-1] & ~ends[:, 2:]
            first, second = one[:, 1:-1][border], one[:, 2:][border]
            rises = second > first
            # The square of a chord rises evenly from the edge on.
            found.append((first**2)[rises] / (second**2 - first**2)[rises])
    steps = np.concatenate(found) if found else np.zeros(0)
    return max(1, round(float(np.quantile(steps, _WIDE)))) if len(steps) else 1
