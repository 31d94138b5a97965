"""Least-squares fit of quadrature nodes to the projections of a full spectrum."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from tomo_polysplat.physics.beer_lambert import projection, shares

__all__ = ["fit_nodes"]

Nodes = tuple[np.ndarray, np.ndarray]

_MAX_EVALUATIONS = 200
_LOG_LIMIT = 60.0  # keeps a rejected trial step from overflowing


def fit_nodes(log_weights: np.ndarray, attenuation: np.ndarray, rays: np.ndarray, count: int) -> Nodes:
    """Fit ``count`` nodes to a spectrum.

    Minimises the error of ``P`` over the given rays, together with the relative error of its slope at 0, by
    Levenberg-Marquardt with analytic derivatives, from groups of neighbouring energies with equal shares of
    the signal. The unknowns are log weights relative to the first node and log attenuations, so that weights
    add up to 1 and everything stays positive. Deterministic.

    Parameters
    ----------
    log_weights, attenuation : (bins,) and (k, bins) arrays
        The full spectrum, for k materials.
    rays : (k, m) array
        Areal densities in g/cm2 that span the range of the scan.
    count : int
        Number of nodes, fewer than ``bins``.

    Returns
    -------
    log_weights, attenuation : (count,) and (k, count) arrays
        Fewer where most of the signal sits at fewer energies.
    """
    from scipy.optimize import least_squares

    target = projection(rays, log_weights, attenuation)
    slope = attenuation @ np.exp(log_weights)
    start = _grouped(log_weights, attenuation, count)
    materials = len(attenuation)

    # Derivatives are asked for where the values have just been.
    @lru_cache(maxsize=1)
    def at(unknowns: bytes) -> tuple[Nodes, tuple[np.ndarray, np.ndarray]]:
        nodes = _unpack(np.frombuffer(unknowns), materials)
        return nodes, shares(rays, *nodes)

    def residuals(unknowns: np.ndarray) -> np.ndarray:
        nodes, (value, _) = at(unknowns.tobytes())
        return np.concatenate([value - target, nodes[1] @ np.exp(nodes[0]) / slope - 1.0])

    def jacobian(unknowns: np.ndarray) -> np.ndarray:
        nodes, (_, share) = at(unknowns.tobytes())
        return np.concatenate([_ray_rows(rays, share, *nodes), _slope_rows(slope, *nodes)])

    solution = least_squares(residuals, _pack(*start), jacobian, method="lm", max_nfev=_MAX_EVALUATIONS)
    return _unpack(solution.x, materials)


def _grouped(log_weights: np.ndarray, attenuation: np.ndarray, count: int) -> Nodes:
    """Neighbouring energies, from the most to the least attenuated, merged into groups of equal weight."""
    order = np.argsort(-attenuation[0], kind="stable")
    weights, curves = np.exp(log_weights)[order], attenuation[:, order]
    middle = np.cumsum(weights) - 0.5 * weights
    _, group = np.unique(np.minimum((middle * count).astype(int), count - 1), return_inverse=True)
    merged = np.bincount(group, weights)
    means = np.stack([np.bincount(group, weights * curve) / merged for curve in curves])
    return np.log(merged), means


def _pack(log_weights: np.ndarray, attenuation: np.ndarray) -> np.ndarray:
    return np.concatenate([log_weights[1:] - log_weights[0], np.log(attenuation).ravel()])


def _unpack(unknowns: np.ndarray, materials: int) -> Nodes:
    count = (unknowns.size + 1) // (materials + 1)
    unknowns = np.clip(unknowns, -_LOG_LIMIT, _LOG_LIMIT)
    relative = np.concatenate([[0.0], unknowns[: count - 1]])
    largest = relative.max()
    log_weights = relative - largest - np.log(np.exp(relative - largest).sum())
    return log_weights, np.exp(unknowns[count - 1 :].reshape(materials, count))


def _ray_rows(
    rays: np.ndarray, share: np.ndarray, log_weights: np.ndarray, attenuation: np.ndarray
) -> np.ndarray:
    """Derivatives of ``P`` along each ray by the unknowns, ``(rays, (k + 1) count - 1)``."""
    by_weight = np.exp(log_weights)[:, None] - share
    by_curve = share * rays[:, None] * attenuation[:, :, None]
    return np.concatenate([by_weight[1:], by_curve.reshape(-1, rays.shape[1])]).T


def _slope_rows(slope: np.ndarray, log_weights: np.ndarray, attenuation: np.ndarray) -> np.ndarray:
    """Derivatives of the relative slope of each of k materials at ``P = 0``, ``(k, (k + 1) count - 1)``."""
    weights, materials = np.exp(log_weights), np.arange(len(attenuation))
    by_weight = weights * (attenuation - (attenuation @ weights)[:, None])
    by_curve = np.zeros((len(materials), len(materials), weights.size))
    by_curve[materials, materials] = weights * attenuation
    return np.concatenate([by_weight[:, 1:], by_curve.reshape(len(materials), -1)], axis=1) / slope[:, None]
