"""Pixels that show the same value in every view, which no measurement does."""

from __future__ import annotations

import numpy as np

__all__ = ["stuck_pixels"]

# In fewer views a value may come again by chance, and as many pixels side by side may be something else: what lies on
# the axis looks the same from all around, where there is no noise.
_FEWEST_VIEWS, _SIDE_BY_SIDE = 8, 4
# A value as large, as a share of the largest, is that of rays without light.
_OPAQUE = 0.98


def stuck_pixels(values: np.ndarray) -> np.ndarray:
    """Which pixels are stuck, (rows, columns): constant, between pixels of their row that are not.

    Air without noise is constant as well, and so are rays without light: values of 0, and as large as any, are not
    told of.

    Parameters
    ----------
    values : (views, rows, columns) array
        -log(I/I0); NaN is no value.
    """
    views, rows, columns = values.shape
    stuck = np.zeros((rows, columns), bool)
    if views < _FEWEST_VIEWS or columns < 3:
        return stuck
    # Three views leave few pixels to look at in all of them.
    first = values[0]
    same = (first == values[views // 2]) & (first == values[-1]) & (first != 0) & np.isfinite(first)
    row, column = np.nonzero(same)
    if not len(row):
        return stuck
    constant = (values[:, row, column] == first[row, column]).all(axis=0)
    stuck[row[constant], column[constant]] = True
    if stuck.any():
        stuck &= first < _OPAQUE * np.max(values, where=np.isfinite(values), initial=0.0)
    for number in np.flatnonzero(stuck.any(axis=1)):
        _keep_narrow(stuck[number])
    return stuck


def _keep_narrow(line: np.ndarray) -> None:
    """Forget those of a row that reach its end, or are too many side by side."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(np.int8), [0]])))
    for begin, end in zip(edges[::2], edges[1::2]):
        if begin == 0 or end == len(line) or end - begin > _SIDE_BY_SIDE:
            line[begin:end] = False
