"""Opaque rays, which no light came through, and dead pixels, of which nothing is known.

A count of 0 has no logarithm, but it tells that the ray is opaque. Without such rays metal may come out hollow where it
is thickest, because only rays past it are left. So an opaque ray gets the logarithm of a small part of a photon. Its
large noise gives it a small weight. A dead pixel counts 0 as well, but has light around it in most views, and stays
where it is, while what metal hides moves over the detector.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from tomo_polysplat.parallel import run_tasks
from tomo_polysplat.scan.shadows import moving_shadows

__all__ = ["fill_opaque", "is_dark", "opaque_value"]

# Photons of an opaque ray. dB without metal / everywhere with 0.1, with 0.5, and with opaque rays left out:
# jaw with amalgam 39.9 / 35.3, 39.8 / 32.9, 37.4 / 35.1; two hips 29.0 / 35.4, 28.1 / 34.0, 28.6 / 30.6;
# nail 6.1 / 34.3, 4.3 / 34.0, 0.7 / 30.6.
_PHOTONS = 0.1
# Rays without light are opaque if the upper quartile of -log(I/I0) around them is this share of log(photons). The
# median there is 0.48 and more beside nine of ten pieces of metal, and 0.1 beside dead pixels in air.
_DARK, _QUARTILE = 0.45, 0.75
# A pixel is dead if it counts nothing in more than the first share of the views, unless it looks opaque in at least
# the second share of these.
_DEAD, _OPAQUE = 0.9, 0.5
_AROUND = np.ones((3, 3))
_STEPS = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0)]


def is_dark(value: float, photons: float) -> bool:
    """Whether a ray with this -log(I/I0) is as dark as those beside opaque rays; never where noise is not known."""
    return 1 < photons < math.inf and value >= _DARK * math.log(photons)


def opaque_value(photons: float) -> float:
    """What `fill_opaque` gives an opaque ray, as rays hold it."""
    return float(np.float32(math.log(photons / _PHOTONS)))


def fill_opaque(values: np.ndarray, photons: float) -> int:
    """Give opaque rays a value, in place, and say how many there were; other rays without light become NaN.

    Parameters
    ----------
    values : (views, rows, columns) float32 array
        -log(I/I0): infinite where no light was counted, NaN where a ray is not to be used.
    photons : float
        Photons of an unattenuated ray; infinity if not known.
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
    if known:
        for pieces, moving in zip(found, moving_shadows(values)):
            if pieces is not None and moving is not None:
                pieces |= moving
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
            view[pieces] = opaque_value(photons)
        filled += int(np.count_nonzero(pieces))
    return filled


def _surrounded(view: np.ndarray, lightless: np.ndarray, dark: float) -> np.ndarray:
    """Which rays without light belong to a connected piece that dark rays surround."""
    labels, number = ndimage.label(lightless, _AROUND)
    row, column = np.nonzero(lightless)
    pairs = []
    for down, across in _STEPS:
        r, c = row + down, column + across
        inside = (r >= 0) & (r < view.shape[0]) & (c >= 0) & (c < view.shape[1])
        r, c, piece = r[inside], c[inside], labels[row[inside], column[inside]]
        finite = np.isfinite(view[r, c])
        pairs.append(piece[finite].astype(np.int64) * view.size + (r * view.shape[1] + c)[finite])
    # A ray that touches several rays of a piece counts once.
    border = np.unique(np.concatenate(pairs))
    piece, place = np.divmod(border, view.size)
    around = np.bincount(piece, minlength=number + 1)
    lit = np.bincount(piece[view.reshape(-1)[place] < dark], minlength=number + 1)
    # Of the sorted values around a piece, the one at the quartile, or the next, is dark.
    surrounded = (around > 0) & (lit <= np.ceil(_QUARTILE * (around - 1)))
    return surrounded[labels]
