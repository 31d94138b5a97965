"""Densities of three curves from attenuation and material numbers, and the way back, compiled for the CPU.

The last lanes begin earlier, so that they end with the Gaussians.
"""

from __future__ import annotations

import numpy as np
import torch

from tomo_polysplat.compiled import njit
from tomo_polysplat.kernels.numba_lanes import LANES, load, padded, store

__all__ = ["pull_weights", "weights"]

# Attenuation, own and shared material numbers, groups, and the curve, as `model.gaussians.Gaussians` has them.
Parts = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def weights(parts: Parts) -> tuple[np.ndarray, np.ndarray]:
    """``Gaussians.weights`` (3, n), and the material numbers (n,), both with room for lanes."""
    attenuation, own, shared, group, curve = parts
    attenuation, numbers = padded(attenuation), torch.from_numpy(padded(own)).clone().numpy()
    made = torch.empty((3, len(attenuation)), dtype=torch.float32).numpy()
    _fill(attenuation, numbers, shared, group, curve, made)
    return made, numbers


def pull_weights(
    parts: Parts, numbers: np.ndarray, gradient: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gradients by attenuation, own and shared numbers, from those by the weights (3, n) that `weights` made."""
    attenuation, _, shared, group, curve = parts
    count, attenuation = len(attenuation), padded(attenuation)
    by_attenuation, by_number = torch.empty((2, len(attenuation)), dtype=torch.float32).numpy()
    by_shared = np.zeros(len(shared))
    _pull(attenuation, numbers, group, curve, padded(gradient), by_attenuation, by_number, by_shared)
    return by_attenuation[:count], by_number[:count], by_shared.astype(np.float32)


@njit(nogil=True, cache=True, error_model="numpy")
def _fill(attenuation, numbers, shared, group, curve, made):
    for n in range(len(group)):
        if group[n] >= 0:
            numbers[n] = shared[group[n]]
    count, one, two = len(attenuation), np.float32(1), np.float32(2)
    for begin in range(0, count, LANES):
        n = min(begin, count - LANES)
        u = load(numbers, n)
        v = one - u
        soft, middle, dense = v * v, two * u * v, u * u
        density = load(attenuation, n) / (curve[0] * soft + curve[1] * middle + curve[2] * dense)
        store(made, n, soft * density)
        store(made, count + n, middle * density)
        store(made, 2 * count + n, dense * density)


@njit(nogil=True, cache=True, error_model="numpy")
def _pull(attenuation, numbers, group, curve, gradient, by_attenuation, by_number, by_shared):
    count, one, two = len(attenuation), np.float32(1), np.float32(2)
    for begin in range(0, count, LANES):
        n = min(begin, count - LANES)
        u, a = load(numbers, n), load(attenuation, n)
        v = one - u
        soft, middle, dense = v * v, two * u * v, u * u
        g0, g1, g2 = load(gradient, n), load(gradient, count + n), load(gradient, 2 * count + n)
        seen = curve[0] * soft + curve[1] * middle + curve[2] * dense
        slope = (g0 * soft + g1 * middle + g2 * dense) / seen
        store(by_attenuation, n, slope)
        # The density of a curve is its share of the attenuation over what a density of 1 would have.
        g0, g1, g2 = g0 - curve[0] * slope, g1 - curve[1] * slope, g2 - curve[2] * slope
        store(by_number, n, two * (u * (g2 - g1) + v * (g1 - g0)) * a / seen)
    for n in range(len(group)):
        if group[n] >= 0:
            by_shared[group[n]] += by_number[n]
            by_number[n] = np.float32(0)
