"""Pixels that show the same value in every view, which no measurement does."""

from __future__ import annotations

import numpy as np

__all__ = ["stuck_pixels"]

# In fewer views a value may repeat by chance. More constant pixels side by side may be real: without noise, matter on
# the axis looks the same from all sides.
_FEWEST_VIEWS, _SIDE_BY_SIDE = 8, 4
# A value above this share of the largest one is that of a ray without light.
_OPAQUE = 0.98
# On both sides of a stuck pixel values change by the first share of the largest, and on one side by the second share.
# Real values with few different counts may be constant where hardly anything changes.
_CHANGES, _CHANGES_MUCH = 0.02, 0.1


def stuck_pixels(values: np.ndarray) -> np.ndarray:
    """Which pixels are stuck, (rows, columns): constant, between pixels of their row that change.

    Pixels at 0 or near the largest value are not reported: air without noise is constant, too, and so are rays
    without light.

    Parameters
    ----------
    values : (views, rows, columns) array
        -log(I/I0); values that are not finite are ignored.
    """
    views, rows, columns = values.shape
    stuck = np.zeros((rows, columns), bool)
    if views < _FEWEST_VIEWS or columns < 3:
        return stuck
    # Three views leave few pixels to look at in all of them.
    first = values[0]
    same = (first == values[views // 2]) & (first == values[-1])
    told = same & (first != 0) & np.isfinite(first)
    if not told.any():
        return stuck
    largest = float(np.max(values, where=np.isfinite(values), initial=0.0))
    told &= first < _OPAQUE * largest
    for row in np.flatnonzero(told.any(axis=1)):
        some = np.flatnonzero(same[row])
        constant = np.zeros(columns, bool)
        constant[some] = (values[:, row, some] == first[row, some]).all(axis=0)
        for begin, end in _runs(constant):
            if begin == 0 or end == columns or end - begin > _SIDE_BY_SIDE or not told[row, begin:end].all():
                continue
            beside = values[:, row, [begin - 1, end]]
            changes = _range(np.where(np.isfinite(beside), beside, np.nan)) / largest
            stuck[row, begin:end] = (changes > _CHANGES).all() and (changes > _CHANGES_MUCH).any()
    return stuck


def _runs(line: np.ndarray) -> list[tuple[int, int]]:
    """Begin and end of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist()))


def _range(values: np.ndarray) -> np.ndarray:
    """Largest minus smallest value of each column, without NaN."""
    return np.fmax.reduce(values, axis=0) - np.fmin.reduce(values, axis=0)
