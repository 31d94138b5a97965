"""The thickness of each pixel's filter out of what a fit leaves of the rays.

A filter takes from each ray in proportion to a slope that the model knows. What a pixel leaves in all views alike is
its gain, or a ring of the object: only how it goes with the slope, from view to view, tells a filter.
"""

from __future__ import annotations

import numpy as np

__all__ = ["filter_left"]

# Eigenvalues of scaled equations below this share of the largest tell nothing.
_RANK = 1e-9


def filter_left(sums: np.ndarray, shapes: np.ndarray, least: np.ndarray) -> np.ndarray:
    """(shapes,) step of the coefficients that explains most of what is left, by least squares.

    Parameters
    ----------
    sums : (5, rows, columns) array
        See `fit.filter_sums.FilterSums`.
    shapes : (shapes, rows, columns) array
        A uniform filter is added to them, and not returned: it is the spectrum's, or the object's density.
    least : (shapes,) array
        Of each step.
    """
    return _solved(*_equations(sums, shapes), least)


def _equations(sums: np.ndarray, shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of the shapes, the last of them uniform, with what each pixel has in common taken out."""
    count, slope, square, left, told = sums
    usual = np.maximum(count, 1e-30)
    matrix = np.maximum(square - slope**2 / usual, 0.0)
    right = told - slope * left / usual
    shapes = np.concatenate([shapes, np.ones_like(shapes[:1])])
    return np.einsum("kij,ij,lij->kl", shapes, matrix, shapes), np.einsum("kij,ij->k", shapes, right)


def _solved(matrix: np.ndarray, right: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Least squares of which no step is below its least."""
    from scipy.optimize import lsq_linear

    size = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    values, vectors = np.linalg.eigh(matrix / size[:, None] / size)
    good = values > _RANK * values[-1]
    root = np.sqrt(values[good])
    factor, target = vectors[:, good].T * root[:, None], (vectors[:, good].T @ (right / size)) / root
    bounds = np.append(least * size[:-1], -np.inf), np.full(len(size), np.inf)
    found: np.ndarray = lsq_linear(factor, target, bounds, method="bvls").x / size
    return found[:-1]
