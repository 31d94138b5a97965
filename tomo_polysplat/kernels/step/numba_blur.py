"""The detector's blur and its slope, compiled for the CPU: see `physics.detector_blur`.

An image is continued by its border, so the blur along an axis is a symmetric matrix, and those of both axes commute:
the adjoint of the blur is the blur.
"""

from __future__ import annotations

import numpy as np
import torch

from tomo_polysplat.compiled import njit
from tomo_polysplat.kernels.numba_lanes import HALF, LANES, halves, load, padded, ramp, store, within

__all__ = ["blur"]


def blur(images: np.ndarray, variance: float, other: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """Blurred float32 images (views, rows, columns), and the derivative of their product with others by the variance.

    0 without others.
    """
    columns = images.shape[2]
    if columns < LANES:
        # A border that goes on changes nothing.
        images = np.pad(images, ((0, 0), (0, 0), (0, LANES - columns)), mode="edge")
    images, others = np.ascontiguousarray(images), padded(images[:0] if other is None else other)
    spread, line = (
        torch.empty(images.shape, dtype=torch.float32).numpy(),
        np.empty(2 * (images.shape[2] + 2), np.float32),
    )
    slope = _blur(images, np.float32(variance), others, line, spread)
    return spread[..., :columns], slope


@njit(nogil=True, cache=True, error_model="numpy")
def _blur(images, variance, other, line, spread):
    """In ``line`` a row stands as blurred along columns, and then what a variance of 1 would add; both continued.

    The last block of a row overlaps the one before it.
    """
    half, none, slope = np.float32(0.5), np.float32(0), 0.0
    views, rows, columns = images.shape
    next_line, sums = columns + 2, np.empty(LANES, np.float32)
    number, zero = halves(none, np.float32(HALF)) + ramp(), halves(none, none)
    for row in range(views * rows):
        start, total = row * columns, zero
        above = start - columns if row % rows > 0 else start
        below = start + columns if row % rows < rows - 1 else start
        for begin in range(0, columns, LANES):
            j = min(begin, columns - LANES)
            here = load(images, start + j)
            more = half * (load(images, above + j) + load(images, below + j)) - here
            store(line, 1 + j, here + variance * more)
            store(line, next_line + 1 + j, more)
        for first in (0, next_line):
            line[first], line[first + columns + 1] = line[first + 1], line[first + columns]
        for begin in range(0, columns, LANES):
            j = min(begin, columns - LANES)
            here = load(line, 1 + j)
            more = half * (load(line, j) + load(line, j + 2)) - here
            store(spread, start + j, here + variance * more)
            if len(other):
                at = next_line + j
                here = load(line, at + 1)
                more = more + here + variance * (half * (load(line, at) + load(line, at + 2)) - here)
                new, past = zero - number, np.float32(j - begin)
                total = total + within(new, past, new, past, more * load(other, start + j))
        if len(other):
            store(sums, 0, total)
            for k in range(LANES):
                slope += sums[k]
    return slope
