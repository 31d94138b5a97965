"""The polychromatic Beer-Lambert law in NumPy, for everything that is not in the optimisation loop."""

from __future__ import annotations

import numpy as np

__all__ = ["projection", "shares"]


def projection(areal: np.ndarray, log_weights: np.ndarray, attenuation: np.ndarray) -> np.ndarray:
    """``P = -log sum_n exp(log_weights_n - sum_k areal_k attenuation_kn)``.

    Parameters
    ----------
    areal : (k, ...) array
        Areal densities in g/cm2 of k base materials along each ray.
    log_weights : (n,) array
    attenuation : (k, n) array
        Mass attenuation in cm2/g.

    Returns
    -------
    (...) array of float64
    """
    return _sum_exponentials(areal, log_weights, attenuation)[0]


def shares(
    areal: np.ndarray, log_weights: np.ndarray, attenuation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """``P`` as from ``projection`` and each node's share ``(n, ...)`` of the transmitted signal.

    The derivatives are ``dP/dareal_k = sum_n share_n attenuation_kn`` and ``dP/dlog_weights_n = -share_n``.
    """
    value, terms, total = _sum_exponentials(areal, log_weights, attenuation)
    return value, terms / total


def _sum_exponentials(
    areal: np.ndarray, log_weights: np.ndarray, attenuation: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    areal = np.asarray(areal, dtype=np.float64)
    # Not by a library of linear algebra, whose last bits depend on the number of its threads.
    exponents = -np.einsum("kn,k...->n...", np.asarray(attenuation, np.float64), areal)
    exponents += np.asarray(log_weights, np.float64).reshape(-1, *[1] * (areal.ndim - 1))
    largest = exponents.max(axis=0)
    terms = np.exp(exponents - largest)
    total = terms.sum(axis=0)
    return -(largest + np.log(total)), terms, total
