"""Fill holes in rows in place. It is compiled, because a dead column of a large scan spoils millions of rows."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.compiled import called, njit

__all__ = ["fill_rows_in_place"]


@njit(nogil=True, cache=True)
def fill_rows_in_place(rows: np.ndarray, valid: np.ndarray) -> None:
    """Replace invalid values, linearly between valid neighbours and constant beyond the outermost ones.

    Parameters
    ----------
    rows : (n, columns) float array
        Changed in place; a row without a valid value becomes 0.
    valid : (n, columns) bool array
    """
    count, columns = rows.shape
    for row in range(count):
        before = np.intp(-1)  # a plain -1 is a type of its own, for which `_bridge` would be compiled as well
        column = 0
        while column < columns:
            if valid[row, column]:
                before = column
                column += 1
                continue
            after = column
            while after < columns and not valid[row, after]:
                after += 1
            _bridge(rows[row], before, after)
            column = after


@called()
def _bridge(values, before, after):
    """Fill the values between two valid columns; -1 or the row's length stand for a missing one."""
    if before < 0 and after == len(values):
        values[:] = 0
    elif before < 0:
        values[:after] = values[after]
    elif after == len(values):
        values[before + 1 :] = values[before]
    else:
        low = np.float64(values[before])
        slope = (np.float64(values[after]) - low) / (after - before)
        for column in range(before + 1, after):
            values[column] = slope * (column - before) + low
