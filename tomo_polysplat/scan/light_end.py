"""Rays at the lower end of the scale: a saturated camera has replaced what is brighter by one value.

The value of such a ray is no measurement, but a bound: there is at least so much light. Where the open field was not
saturated the value lies above 0, and rays well inside of such an area pass beside the object.
"""

from __future__ import annotations

import logging
import math

import numpy as np

__all__ = ["lower_end", "mend_light_end"]

logger = logging.getLogger(__name__)

# So many rays, and such a share of all, are at the end at least.
_FEWEST, _SHARE = 10, 2e-4
# Of these, the share that has no other neighbours. Noise cut off at the mean of air, as by ``numpy.maximum``, leaves
# 2^-9 of them, and a cut at one standard deviation, which does no harm, a quarter.
_INSIDE = 0.5
# Air of no more than this is 0 to rounding, as of simulated scans without noise; a step of 16 bits is 1.5e-5.
_ROUNDING = 2.0**-20


def mend_light_end(values: np.ndarray) -> int:
    """Say that a camera was saturated, whose open field was not; let rays in such areas pass beside the object.

    Parameters
    ----------
    values : (views, rows, columns) float32 array
        -log(I/I0), changed in place; NaN where a ray is not to be used. Saturated rays become 0, and those at the
        border, which may pass through thin matter, NaN.

    Returns
    -------
    int
        Saturated rays.
    """
    low = lower_end(values)
    if low is None:
        return 0
    wide, many, left_out = _width(values, low), 0, 0
    # View by view: a mark for every ray would be a quarter of all that the rays take.
    for view in values:
        saturated = view == low
        near = saturated & _within(~saturated, wide)
        view[saturated], view[near] = 0.0, np.nan
        many, left_out = many + int(np.count_nonzero(saturated)), left_out + int(np.count_nonzero(near))
    share = f"{100 * many / values.size:.2g} % of the rays hold the same value, the least of all, {low:.3g}"
    words = f"they are taken to pass beside the object, but for {left_out} at the border, which are left out"
    remedy = "measure with less light; where that cannot be, with an open field that is not saturated"
    logger.warning("%s: the detector was saturated there; %s: %s.", share, words, remedy)
    return many


def lower_end(values: np.ndarray) -> float | None:
    """The value (above 0) of rays (views, rows, columns) at the lower end of the scale; None where there is no end.

    Of an open field that was saturated, too, air holds 0. So it does without noise, and that is no end: `check` asks.
    """
    # Not the minimum, which NaN would be; nor where values are finite, which takes ten times as long.
    low = min((float(np.fmin.reduce(view, axis=None)) for view in values), default=np.inf)
    if not math.isfinite(low) or low <= _ROUNDING:
        return None
    numbers = [int(np.count_nonzero(view == low)) for view in values]
    if min(numbers) == 0 or sum(numbers) <= max(_FEWEST, _SHARE * values.size):
        return None
    inside = sum(int(np.count_nonzero(~_within(view != low, 1))) for view in values)
    return low if inside >= _INSIDE * sum(numbers) else None


def _within(rays: np.ndarray, wide: int) -> np.ndarray:
    """Rays (rows, columns) no more than so many pixels from some, along rows and columns."""
    from scipy.ndimage import maximum_filter

    return maximum_filter(rays, size=2 * wide + 1, mode="nearest")


def _width(values: np.ndarray, low: float) -> int:
    """Pixels at the border that may see matter: as far as a round edge goes on from the first ray above the end."""
    found = []
    for view in values:
        ends = view == low
        found.append(np.abs(np.diff(view, axis=1))[ends[:, 1:] != ends[:, :-1]])
    steps = np.concatenate(found)
    steps = steps[np.isfinite(steps)]
    # The chord of a round edge rises with the root of the depth: half as far as its slope there tells.
    return max(1, round(0.5 * low / float(np.median(steps)))) if len(steps) else 1
