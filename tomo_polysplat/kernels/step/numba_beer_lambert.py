"""The polychromatic projection and its slopes in one go, compiled for the CPU: see `physics.transmission`."""

from __future__ import annotations

import numpy as np
import torch

from tomo_polysplat.compiled import njit
from tomo_polysplat.kernels.numba_lanes import (
    LANES,
    halves,
    larger,
    load,
    logarithm,
    padded,
    power_of_two,
    store,
    tasks_of_lanes,
)
from tomo_polysplat.parallel import run_tasks

__all__ = ["beer_lambert"]

# Of a logarithm to base 2; a share of light below 2^-126 is none.
_BY_LOG_2, _LEAST = np.float32(1.4426950408889634), np.float32(-126)


def beer_lambert(
    areal: torch.Tensor, log_weights: torch.Tensor, attenuation: torch.Tensor, slopes: bool
) -> tuple[torch.Tensor, torch.Tensor]:
    """P of rays, and its derivatives by their areal densities if ``slopes`` are asked for.

    Parameters
    ----------
    areal : (curves, rays) float32 tensor
        Of one curve or three.
    log_weights : (nodes, 1) or (nodes, rays) float32 tensor
    attenuation : (nodes, curves) float32 tensor

    Returns
    -------
    (rays) tensor, (curves, rays) tensor or one without numbers
    """
    rays = areal.shape[1]
    paths, curves = padded(areal.numpy()), attenuation.numpy()
    weights = log_weights.numpy() if log_weights.shape[1] == 1 else padded(log_weights.numpy())
    value, by_areal = areal.new_empty(paths.shape[1]), areal.new_empty(paths.shape if slopes else (0, 0))
    parts = (paths, weights, curves, value.numpy(), by_areal.numpy())
    run_tasks(lambda a, b: _project(a, b, *parts), tasks_of_lanes(len(value)))
    return value[:rays], by_areal[:, :rays]


@njit(nogil=True, cache=True, error_model="numpy")
def _project(first, last, areal, log_weights, attenuation, value, slopes):
    """The last block overlaps the one before it."""
    none = np.float32(0)
    zero = halves(none, none)
    rays, three, of_rays = len(value), len(areal) > 1, log_weights.shape[1] > 1
    for start in range(first, last, LANES):
        at = min(start, rays - LANES)
        a = load(areal, at)
        b, c = (load(areal, rays + at), load(areal, 2 * rays + at)) if three else (a, a)
        most = d = e = f = total = zero
        for again in range(2):
            for n in range(len(attenuation)):
                exponent = load(log_weights, n * rays + at) if of_rays else zero + log_weights[n, 0]
                exponent = exponent - attenuation[n, 0] * a
                if three:
                    exponent = exponent - attenuation[n, 1] * b - attenuation[n, 2] * c
                if not again:
                    most = larger(exponent, most) if n else exponent
                    continue
                term = power_of_two(larger((exponent - most) * _BY_LOG_2, _LEAST))
                total, d = total + term, d + attenuation[n, 0] * term
                if three:
                    e, f = e + attenuation[n, 1] * term, f + attenuation[n, 2] * term
        store(value, at, none - (most + logarithm(total)))
        if len(slopes):
            share = power_of_two(none - logarithm(total) * _BY_LOG_2)
            store(slopes, at, d * share)
            if three:
                store(slopes, rays + at, e * share)
                store(slopes, 2 * rays + at, f * share)
