"""Rays that no light came through, told from rays of which nothing is known.

A count of 0 has no logarithm, but it says something: the ray is opaque. Left out, metal may come out hollow where it
is thickest, as only rays past it are known. So the ray gets the value that a small part of a photon has; how little
that weighs its noise says. A dead pixel counts 0 as well, but with light all around it.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

__all__ = ["fill_opaque"]

# Photons that a ray without any is taken for. With 0.1 and 0.5, without metal / everywhere: a jaw with amalgam 39.9 /
# 35.3 and 39.8 / 32.9 dB, two hips 29.0 / 35.4 and 28.1 / 34.0, a nail 6.1 / 34.3 and 4.3 / 34.0; left out 37.4 / 35.1,
# 28.6 / 30.6 and 0.7 / 30.6.
_PHOTONS = 0.1
# Next to opaque rays there is hardly any light: the upper quartile there, as a share of the logarithm of the photons of
# an unattenuated ray. The median is 0.48 and more beside nine of ten pieces of metal, 0.1 beside dead pixels in air.
_DARK, _QUARTILE = 0.45, 0.75
# What counts nothing in so many views is a dead pixel.
_DEAD = 0.9
_AROUND = np.ones((3, 3))


def fill_opaque(values: np.ndarray, photons: float) -> int:
    """Give opaque rays a value, in place, and say how many there were; other rays without light become NaN.

    Parameters
    ----------
    values : (views, rows, columns) float32 array
        -log(I/I0): infinite where no light was counted, NaN where a ray is not to be used.
    photons : float
        Of an unattenuated ray; infinity where it is not known.
    """
    number, dead = 0, sum(np.isposinf(view).astype(np.int32) for view in values) > _DEAD * len(values)
    for view in values:
        view[dead & np.isposinf(view)] = np.nan
        lightless = np.isposinf(view)
        if not lightless.any():
            continue
        if 1 < photons < math.inf:
            filled = _opaque_pieces(view, lightless, _DARK * math.log(photons))
            # As opaque as any that was measured, at least.
            largest = float(view[np.isfinite(view)].max(initial=0.0))
            view[filled] = max(math.log(photons / _PHOTONS), largest)
            number += int(np.count_nonzero(filled))
            lightless &= ~filled
        view[lightless] = np.nan
    return number


def _opaque_pieces(view: np.ndarray, lightless: np.ndarray, dark: float) -> np.ndarray:
    """Which rays without light belong to a piece that dark rays surround."""
    labels, _ = ndimage.label(lightless, _AROUND)
    opaque = np.zeros_like(lightless)
    for label, box in enumerate(ndimage.find_objects(labels), 1):
        near = tuple(slice(max(part.start - 1, 0), part.stop + 1) for part in box)
        piece, seen = labels[near] == label, view[near]
        border = seen[ndimage.binary_dilation(piece, _AROUND) & np.isfinite(seen)]
        if len(border) and np.quantile(border, _QUARTILE, method="higher") >= dark:
            opaque[near] |= piece
    return opaque
