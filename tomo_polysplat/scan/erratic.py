"""Pixels that hold no measurement: without light in some views, and brighter than the open beam in others.

So are pixels whose flat field has next to no light: what is divided by it is noise, of either sign.
"""

from __future__ import annotations

import numpy as np

__all__ = ["erratic_pixels"]

# -log(I/I0) of a ray with 1.65 times the light of the open beam, and the share of the views that has to be so, and
# without light: a gamma ray hits a pixel behind metal once or twice.
_BRIGHTER, _SOME = -0.5, 0.1
# Most pixels around, so many along either axis, have less than this share of it: of a few photons all have it.
_AROUND, _LESS = 5, 0.1


def erratic_pixels(values: np.ndarray) -> np.ndarray:
    """Which pixels are so, (rows, columns).

    Parameters
    ----------
    values : (views, rows, columns) array
        -log(I/I0); infinite without light, NaN where a ray is left out anyway.
    """
    from scipy.ndimage import median_filter

    dark, bright = (np.zeros(values.shape[1:], np.int64) for _ in range(2))
    for view in values:
        dark += np.isposinf(view)
        bright += view < _BRIGHTER
    both = np.minimum(dark, bright)
    found = both > _SOME * len(values)
    return found & (median_filter(both, _AROUND) < _LESS * both) if found.any() else found
