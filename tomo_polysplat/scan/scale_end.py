"""Rays at the upper end of the scale: a program has replaced what is darker by one value.

Counts are often clipped before the logarithm, as by ``numpy.clip(transmission, 1e-4, None)``. The value of such a ray
is no measurement, but a bound.
"""

from __future__ import annotations

import math

import numpy as np

from tomo_polysplat.parallel import of_parts
from tomo_polysplat.scan.extremes import largest
from tomo_polysplat.scan.noise import photons_per_ray
from tomo_polysplat.scan.opaque import fill_opaque, is_dark

__all__ = ["ONE_PHOTON", "dark_end", "fill_dark_end"]

# Noise and detail repeat no value exactly: rays at the end are so many, this share of all at least, and this many
# times as many as those of any other value among some of the largest. Counts of few photons do repeat.
_FEWEST, _SHARE, _OFTEN = 10, 2e-4, 3
_LOOKED_AT = 1 << 18
# Of counts, one photon is a measurement, and the next darkest ray has two.
ONE_PHOTON = 1e-4


def fill_dark_end(values: np.ndarray) -> tuple[int, list[float]]:
    """Give rays at the upper end of the scale that of opaque ones, in place, where no light can have come.

    An end at less than a photon stays: it is as good a guess as that of opaque rays.

    Parameters
    ----------
    values : (views, rows, columns) float32 array
        -log(I/I0); NaN where a ray is not to be used.

    Returns
    -------
    number : int
        How many there were; others at the end stay as they are.
    given : list of float
        What rays at an end hold now: none has noise.
    """
    opaque, value, end = dark_end(values)
    if opaque is None:
        return 0, [end] if math.isfinite(end) else []
    values[opaque] = value
    return int(np.count_nonzero(opaque)), sorted({value, end})


def dark_end(values: np.ndarray) -> tuple[np.ndarray | None, float, float]:
    """Which rays `fill_dark_end` gives which value, and the end of the scale; None and infinity where there is none.

    Parameters are its own.
    """
    ended, end = _at_the_end(values)
    if ended is None:
        return None, end, math.inf
    clipped = np.where(ended, np.float32(np.inf), values)
    # Without the rays at the end, which all have the same value, and so no noise.
    photons = photons_per_ray(clipped)
    if not is_dark(end, photons):
        return None, end, end
    fill_opaque(clipped, photons)
    opaque = ended & np.isfinite(clipped)
    if not opaque.any():
        return None, end, end
    value = float(clipped[opaque][0])
    return opaque, end if math.log(photons) <= end <= value else value, end


def _at_the_end(values: np.ndarray) -> tuple[np.ndarray | None, float]:
    """Which rays have the largest value, where that is the end of the scale (None otherwise), and that value."""
    end = largest(values, below=math.inf)
    if not end > 0:
        return None, end
    number = sum(of_parts(lambda part: int(np.count_nonzero(part == end)), values))
    if number <= max(_FEWEST, _SHARE * values.size):
        return None, end
    if abs(end - largest(values, below=end) - math.log(2)) < ONE_PHOTON:
        return None, end
    step = -(-values.size // _LOOKED_AT)
    some = values.reshape(-1)[::step]
    others = some[np.isfinite(some) & (some != end)]
    often = np.unique(others, return_counts=True)[1].max(initial=0)
    if number <= _OFTEN * step * often and np.count_nonzero(some == end) <= _OFTEN * often:
        return None, end
    return values == end, end
