"""The shape of a bowtie or a heel over a detector, by a few numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

__all__ = ["BOWTIE", "HEEL", "filter_shapes", "filter_thickness"]

# Powers of the place along columns that no side has more of, and those that one side has: of the place, -1 to 1 over
# the detector, along its columns (u) and its rows (v).
BOWTIE, HEEL = ("u2", "u4"), ("u", "v")
_POWERS = {"u": (1, 0), "u2": (2, 0), "u4": (4, 0), "v": (0, 1)}


def filter_shapes(rows: int, columns: int, names: Sequence[str]) -> np.ndarray:
    """(names, rows, columns) float64: each power of the place, at the pixels' middles."""
    u, v = ((2 * np.arange(n) + 1) / n - 1 for n in (columns, rows))
    shapes = np.empty((len(names), rows, columns))
    for shape, name in zip(shapes, names):
        across, down = _POWERS[name]
        shape[:] = u**across * v[:, None] ** down
    return shapes


def filter_thickness(coefficients: Mapping[str, float], rows: int, columns: int) -> np.ndarray:
    """(rows, columns) of a filter, in the unit of its coefficients; 0 where it is thinnest.

    What all pixels have in common does not show as a shape: it belongs to the spectrum.
    """
    names = tuple(coefficients)
    shapes = filter_shapes(rows, columns, names)
    thickness = np.einsum("k,kij->ij", [float(coefficients[name]) for name in names], shapes)
    return np.asarray(thickness - thickness.min())
