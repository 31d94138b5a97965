"""Rays that no light came through, told from rays of which nothing is known.

A count of 0 has no logarithm, but it says something: the ray is opaque. Left out, metal may come out hollow where it
is thickest, as only rays past it are known. So the ray gets the value that a small part of a photon has; how little
that weighs its noise says. A dead pixel counts 0 as well, but with light around it in most views.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from tomo_polysplat.parallel import run_tasks

__all__ = ["fill_opaque"]

# Photons that a ray without any is taken for. With 0.1 and 0.5, without metal / everywhere: a jaw with amalgam 39.9 /
# 35.3 and 39.8 / 32.9 dB, two hips 29.0 / 35.4 and 28.1 / 34.0, a nail 6.1 / 34.3 and 4.3 / 34.0; left out 37.4 / 35.1,
# 28.6 / 30.6 and 0.7 / 30.6.
_PHOTONS = 0.1
# Next to opaque rays there is hardly any light: the upper quartile there, as a share of the logarithm of the photons of
# an unattenuated ray. The median is 0.48 and more beside nine of ten pieces of metal, 0.1 beside dead pixels in air.
_DARK, _QUARTILE = 0.45, 0.75
# A pixel that counts nothing in so many views is dead, unless it looks opaque in so many of these.
_DEAD, _OPAQUE = 0.9, 0.5
_AROUND = np.ones((3, 3))
_STEPS = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0)]


def fill_opaque(values: np.ndarray, photons: float) -> int:
    """Give opaque rays a value, in place, and say how many there were; other rays without light become NaN.

    Parameters
    ----------
    values : (views, rows, columns) float32 array
        -log(I/I0): infinite where no light was counted, NaN where a ray is not to be used.
    photons : float
        Of an unattenuated ray; infinity where it is not known.
    """
    without, opaque = (np.zeros(values.shape[1:], np.int32) for _ in range(2))
    known = 1 < photons < math.inf
    found: list[np.ndarray | None] = [None] * len(values)

    def look(number: int) -> None:
        lightless = np.isposinf(values[number])
        if lightless.any():
            dark = _DARK * math.log(photons) if known else math.inf
            found[number] = lightless & _surrounded(values[number], lightless, dark)

    run_tasks(look, [(number,) for number in range(len(values))])
    for view, pieces in zip(values, found):
        if pieces is not None:
            without += np.isposinf(view)
            opaque += pieces
    dead = (without > _DEAD * len(values)) & (opaque < _OPAQUE * without)
    filled = 0
    for view, pieces in zip(values, found):
        if pieces is None:
            continue
        pieces &= ~dead
        view[np.isposinf(view)] = np.nan
        if known:
            view[pieces] = math.log(photons / _PHOTONS)
        filled += int(np.count_nonzero(pieces))
    return filled


def _surrounded(view: np.ndarray, lightless: np.ndarray, dark: float) -> np.ndarray:
    """Which rays without light belong to a piece that dark rays surround, of however many pieces there are."""
    labels, number = ndimage.label(lightless, _AROUND)
    row, column = np.nonzero(lightless)
    pairs = []
    for down, across in _STEPS:
        r, c = row + down, column + across
        inside = (r >= 0) & (r < view.shape[0]) & (c >= 0) & (c < view.shape[1])
        r, c, piece = r[inside], c[inside], labels[row[inside], column[inside]]
        finite = np.isfinite(view[r, c])
        pairs.append(piece[finite].astype(np.int64) * view.size + (r * view.shape[1] + c)[finite])
    # A ray beside several of a piece's counts once.
    border = np.unique(np.concatenate(pairs))
    piece, place = np.divmod(border, view.size)
    around = np.bincount(piece, minlength=number + 1)
    lit = np.bincount(piece[view.reshape(-1)[place] < dark], minlength=number + 1)
    # Of the sorted values around a piece, the one at the quartile, or the next, is dark.
    surrounded = (around > 0) & (lit <= np.ceil(_QUARTILE * (around - 1)))
    return surrounded[labels]
