"""The shape of a filter over a detector, by a few numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tomo_polysplat.physics.materials import density
from tomo_polysplat.units import cm_per

__all__ = ["bowtie_map", "filter_shapes", "filter_thickness"]

# Powers of the place along the detector's columns, -1 to 1.
_POWERS = {"parabola": 2, "slope": 1}


def filter_shapes(rows: int, columns: int, names: Sequence[str]) -> np.ndarray:
    """(names, rows, columns) float64: each power of the place, at the pixels' middles."""
    place = (2 * np.arange(columns) + 1) / columns - 1
    powers = np.stack([place ** _POWERS[name] for name in names])
    return np.repeat(powers[:, None], rows, axis=1)


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
