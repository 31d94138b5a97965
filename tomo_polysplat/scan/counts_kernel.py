"""Line integrals of counts, compiled: a large scan has 1e9 rays, and NumPy would go over them ten times."""

from __future__ import annotations

import math

import numpy as np

from tomo_polysplat.compiled import njit

__all__ = ["KINDS", "count_kinds", "line_integrals_of_counts"]

# What a ray may be that was not measured properly, in the order in which it is asked.
KINDS = ("not_finite", "saturated", "dead_pixel", "no_light")


# A compiled function takes arrays and numbers alone.
@njit(nogil=True, cache=True)
def line_integrals_of_counts(counts, flat, dark, limit, made, usable, found):
    """``-log((counts - dark) / (flat - dark))`` of some rows of a view; see `tomo_polysplat.scan.defects.attenuation`.

    Parameters
    ----------
    counts : (rows, columns) uint16 or float64 array
    flat, dark : (rows, columns) float64 arrays
    limit : float
        Counts from which the detector is saturated.
    made, usable : (rows, columns) float32 and bool arrays
        Where the line integrals go, and which of them are valid.
    found : (4,) int64 array
        Rays of each of `KINDS`, to which those found here are added.
    """
    for row in range(counts.shape[0]):
        for column in range(counts.shape[1]):
            value, background = np.float64(counts[row, column]), dark[row, column]
            light = flat[row, column] - background
            integral, kind = 0.0, 0
            if not math.isfinite(value):
                kind = 1
            elif value >= limit:
                # The open beam has more light than the detector can tell.
                integral, kind = -math.inf if flat[row, column] > limit else 0.0, 2
            elif not (math.isfinite(light) and light > 0):
                kind = 3
            elif value - background > 0:
                integral = -math.log((value - background) / light)
            else:
                integral, kind = math.inf, 4
            made[row, column] = integral
            usable[row, column] = kind == 0
            if kind:
                found[kind - 1] += 1


@njit(nogil=True, cache=True)
def count_kinds(counts, flat, dark, limit, found):
    """What `line_integrals_of_counts` adds to ``found``, without a logarithm."""
    not_finite, saturated, dead, no_light = 0, 0, 0, 0
    for row in range(counts.shape[0]):
        for column in range(counts.shape[1]):
            value, background = np.float64(counts[row, column]), dark[row, column]
            light = flat[row, column] - background
            finite, below = math.isfinite(value), value < limit
            lit = math.isfinite(light) and light > 0
            not_finite += not finite
            saturated += finite & (not below)
            dead += finite & below & (not lit)
            no_light += finite & below & lit & (value <= background)
    for kind, number in enumerate((not_finite, saturated, dead, no_light)):
        found[kind] += number
