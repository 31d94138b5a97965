"""Sets of rays that span what a scan can contain, to fit and to judge a quadrature on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_number
from tomo_polysplat.physics.beer_lambert import projection, shares

__all__ = ["MaxPath", "span_rays"]

# The largest projection value of the scan, or the largest areal density (g/cm2) of each base material.
MaxPath = float | Sequence[float]

_STEPS = (
    200  # of the tables of P along a direction; only places the samples, which are then evaluated exactly
)
# Of Newton's method, whose steps end when they are as small as that beside what is sought.
_NEWTON_STEPS, _TOLERANCE = 100, 1e-12


def span_rays(
    log_weights: np.ndarray, attenuation: np.ndarray, max_path: MaxPath, divisions: int, levels: np.ndarray
) -> np.ndarray:
    """Areal densities ``(3, rays)`` in g/cm2 of rays that span the range of a scan; ``(1, rays)`` of one material.

    Parameters
    ----------
    log_weights, attenuation : (n,) and (3, n) or (1, n) arrays
        The full spectrum.
    max_path : float or three floats
        Largest projection value, or, with three materials, the largest areal density of each.
    divisions : int
        The mixtures are a lattice of this many steps between the pure materials.
    levels : (m,) array
        Samples along each mixture as fractions of its largest P.
    """
    directions, reach = _directions(log_weights, attenuation, max_path, divisions)
    steps = np.geomspace(1e-8, 1.0, _STEPS)
    rays = []
    for direction, end in zip(directions.T, reach):
        line = direction[:, None] * (end * steps)
        values = projection(line, log_weights, attenuation)
        rays.append(direction[:, None] * (end * np.interp(levels * values[-1], values, steps)))
    return np.concatenate(rays, axis=1)


def _directions(
    log_weights: np.ndarray, attenuation: np.ndarray, max_path: MaxPath, divisions: int
) -> tuple[np.ndarray, np.ndarray]:
    """Mixtures ``(3, m)`` or ``(1, 1)``, and how far along each the scan reaches ``(m,)``."""
    lattice = _lattice(len(attenuation), divisions)
    if np.ndim(max_path) == 0:
        largest = require_number(
            "max_path", max_path, above=0.0, remedy="the largest projection value of the scan"
        )
        pure = _reach(np.eye(len(attenuation)), log_weights, attenuation, largest)
        directions = lattice * pure[:, None]
        return directions, _reach(directions, log_weights, attenuation, largest)
    maxima = require_array("max_path", max_path, ndim=1).astype(np.float64)
    if maxima.shape != (len(lattice),) or not (
        np.isfinite(maxima).all() and (maxima >= 0).all() and maxima.any()
    ):
        raise fail("max_path", "a projection value or three areal densities in g/cm2", repr(max_path))
    directions = lattice * maxima[:, None]
    present = directions.any(axis=0)
    return directions[:, present], 1.0 / lattice[maxima > 0].max(axis=0)[present]


def _lattice(materials: int, divisions: int) -> np.ndarray:
    """Shares ``(materials, m)`` of one material or of three, a lattice between the pure ones."""
    if materials == 1:
        return np.ones((1, 1))
    shares = [(i, j, divisions - i - j) for i in range(divisions + 1) for j in range(divisions + 1 - i)]
    return np.array(shares).T / divisions


def _reach(
    directions: np.ndarray, log_weights: np.ndarray, attenuation: np.ndarray, largest: float
) -> np.ndarray:
    """Multiple of each direction ``(3, m)`` at which P reaches ``largest``."""
    slope, reach = directions.T @ attenuation, np.zeros(directions.shape[1])
    for _ in range(_NEWTON_STEPS):
        value, share = shares(reach * directions, log_weights, attenuation)
        # P is concave: from below, Newton's steps come nearer and never too far.
        step = (largest - value) / np.einsum("mn,nm->m", slope, share)
        reach = reach + step
        if (np.abs(step) <= _TOLERANCE * reach).all():
            break
    return reach
