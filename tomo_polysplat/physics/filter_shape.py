"""The shape of a filter over a detector, by a few numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tomo_polysplat.physics.materials import density
from tomo_polysplat.units import cm_per

__all__ = ["bowtie_map", "filter_shapes", "filter_thickness"]

# Powers of the place, -1 to 1 over the detector, along its columns (u) and its rows (v).
_POWERS = {"u": (1, 0), "u2": (2, 0), "v": (0, 1)}


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


def bowtie_map(
    coefficients: Mapping[str, float], rows: int, columns: int, unit: str = "cm"
) -> tuple[str, np.ndarray, float] | None:
    """The map of a bowtie of aluminium, as `tomo_polysplat.reconstruct` takes it; None of no coefficients.

    Parameters
    ----------
    coefficients : mapping
        In cm, as ``result.plan["bowtie"].value`` has them.
    rows, columns : int
        Pixels of the detector.
    unit : str
        Of the scan the map is for.
    """
    if not coefficients:
        return None
    thickness = filter_thickness(coefficients, rows, columns) / cm_per(unit)
    return "Al", thickness.astype(np.float32), density("Al")
