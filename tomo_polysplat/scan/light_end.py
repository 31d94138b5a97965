"""Rays at the lower end of the scale: a saturated camera has replaced what is brighter by one value.

The value of such a ray is no measurement, but a bound: there is at least so much light. Where the open field was not
saturated the value lies above 0, and rays well inside of such an area pass beside the object.
"""

from __future__ import annotations

import logging
import math

import numpy as np

__all__ = ["mend_light_end", "saturated_rays"]

logger = logging.getLogger(__name__)

# So many rays, and such a share of all, are at the end at least.
_FEWEST, _SHARE = 10, 2e-4
# Of these, the share that has no other neighbours. Noise cut off at the mean of air, as by ``numpy.maximum``, leaves
# 2^-9 of them, and a cut at one standard deviation, which does no harm, a quarter.
_INSIDE = 0.5


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
    saturated = saturated_rays(values)
    if saturated is None:
        return 0
    many, low = int(np.count_nonzero(saturated)), float(values[saturated][0])
    share = f"{100 * many / values.size:.2g} % of the rays hold the same value, the least of all, {low:.3g}"
    remedy = "measure with less light; where that cannot be, with an open field that is not saturated"
    wide = _width(values, saturated, low)
    near = saturated & _within(~saturated, wide)
    values[saturated] = 0.0
    values[near] = np.nan
    words = "they are taken to pass beside the object, but for %d at the border, which are left out"
    logger.warning("%s: the detector was saturated there; " + words + ": %s.", share, near.sum(), remedy)
    return many


def saturated_rays(values: np.ndarray) -> np.ndarray | None:
    """Which rays are at the lower end of the scale, (views, rows, columns); None where that is no end.

    Of an open field that was saturated, too, air holds 0. So it does without noise, and that is no end: `check` asks.
    """
    # Not the minimum, which NaN would be; nor where values are finite, which takes ten times as long.
    low = min((float(np.fmin.reduce(view, axis=None)) for view in values), default=np.inf)
    if not math.isfinite(low) or low <= 0:
        return None
    number = sum(int(np.count_nonzero(view == low)) for view in values)
    if number <= max(_FEWEST, _SHARE * values.size):
        return None
    at_end = values == low
    inside = at_end & ~_within(~at_end, 1)
    if np.count_nonzero(inside) < _INSIDE * number or not at_end.any(axis=(1, 2)).all():
        return None
    return at_end


def _within(rays: np.ndarray, wide: int) -> np.ndarray:
    """Rays no more than so many pixels from some of a view, along rows and columns."""
    from scipy.ndimage import maximum_filter

    return maximum_filter(rays, size=(1, 2 * wide + 1, 2 * wide + 1), mode="nearest")


def _width(values: np.ndarray, saturated: np.ndarray, low: float) -> int:
    """Pixels at the border that may see matter: as far as a round edge goes on from the first ray above the end."""
    steps = np.abs(np.diff(values, axis=2))[saturated[..., 1:] != saturated[..., :-1]]
    steps = steps[np.isfinite(steps)]
    # The chord of a round edge rises with the root of the depth: half as far as its slope there tells.
    return max(1, round(0.5 * low / float(np.median(steps)))) if len(steps) else 1
