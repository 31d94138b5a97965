"""Are rows, views and columns where they should be?"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.scan.probes.finding import DEFECT, OK, UNKNOWN, Finding
from tomo_polysplat.scan.probes.measured import Measured

__all__ = ["AXES", "probe_axes"]

AXES = "order of axes"
_NAMES = ("rows", "views", "columns")
# An order of axes is doubted when another one keeps sums this many times more constant.
_MUCH_BETTER = 4.0
_LARGE = 0.03
# What is air, as a share of the large values.
_AIR = 0.06


def probe_axes(measured: Measured) -> Finding:
    """Check that what a detector row sees in all does not change as the object turns.

    In a parallel beam the sum over the columns is the mass of a slice and the same in every view; in a cone
    beam nearly so. An order of axes is judged by the part of these sums' scatter that is along the views.
    """
    scan = measured.scan
    values = np.where(measured.valid, scan.projections, np.float32(measured.level))
    if min(scan.views, scan.columns) < 3:
        return Finding(AXES, UNKNOWN, "too few views or columns", "three of each or more")
    scatter = {(1, 2): _scatter(values, 1, 2)}
    # Axes of different length cannot be confused: the geometry's lengths would not fit.
    if scan.views == scan.columns:
        scatter[2, 1] = _scatter(values, 2, 1)
    if scan.rows > 1 and scan.rows == scan.columns:
        scatter[1, 0] = _scatter(values, 1, 0)
    if scan.rows > 1 and scan.rows == scan.views:
        scatter[0, 2] = _scatter(values, 0, 2)
    numbers = {f"views={_NAMES[v]}, columns={_NAMES[c]}": value for (v, c), value in scatter.items()}
    best = min(scatter, key=lambda order: scatter[order])
    given = scatter[1, 2]
    if best == (1, 2) or given < _LARGE or given < _MUCH_BETTER * scatter[best]:
        text = f"as stated: the sum over the columns changes by {100 * given:.2g} % between views"
        return Finding(AXES, OK, text, "", numbers)
    if not _ends_in_air(values, best[1], measured.level):
        text = "the object fills the view, and no order of the axes shows the same mass in all views"
        return Finding(AXES, UNKNOWN, text, "a view of the whole object", numbers)
    swapped = {(2, 1): (1, 2), (1, 0): (0, 2), (0, 2): (0, 1)}[best]
    first, second = (_NAMES[axis] for axis in swapped)
    text = f"{first} and {second} look swapped: then the sum over the columns hardly changes between views"
    return Finding(AXES, DEFECT, text, f"numpy.swapaxes(projections, {swapped[0]}, {swapped[1]})", numbers)


def _ends_in_air(values: np.ndarray, columns: int, level: float) -> bool:
    """Whether there is air at both ends of the axis `columns`."""
    ends = values.take([0, -1], axis=columns)
    return bool(np.abs(ends.mean(axis=tuple(k for k in range(3) if k != columns))).max() < _AIR * level)


def _scatter(values: np.ndarray, views: int, columns: int) -> float:
    """Standard deviation along `views` of the sums over `columns`, relative to the largest mean of a row."""
    sums = values.sum(axis=columns, keepdims=True, dtype=np.float64)
    spread, mean = sums.std(axis=views), np.abs(sums.mean(axis=views))
    return float(np.sqrt(np.mean(spread**2)) / max(mean.max(), 1e-30))
