"""Weights of measured rays, and the misfit of predicted ones with its slope, compiled for the CPU.

What ``fit.rays.Rays.batch`` and ``fit.loss.misfit`` say in torch, operation by operation, which takes a small cloud
several times as long. Rays are taken by lanes; the last of these begin earlier, so that they end with the rays.
"""

from __future__ import annotations

import numpy as np
import torch

from tomo_polysplat.compiled import njit
from tomo_polysplat.kernels.numba_lanes import (
    HALF,
    LANES,
    TASK,
    halves,
    inverse_root,
    larger,
    load,
    padded,
    power_of_two,
    ramp,
    smaller,
    store,
    tasks_of_lanes,
    within,
)
from tomo_polysplat.parallel import run_tasks

__all__ = ["misfit_sums", "weigh"]

# Rays that float32 adds up.
_ADDED = 64 * LANES
# Of a logarithm to base 2; the exponential of more than this is too large for float32, and so counts as endless; the
# exponent of the smallest power of two.
_BY_LOG_2, _OPAQUE, _LEAST = np.float32(1.4426950408889634), np.float32(87), np.float32(-126)
_LARGEST, _SMALLEST = np.float32(3e38), np.float32(1e-30)


def weigh(
    measured: torch.Tensor, aside: torch.Tensor, noise: float, dimmed: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Values, 0 where unusable, and weights of the rays that are fitted and of those ``aside``.

    Parameters
    ----------
    measured, aside : (views, rows, columns) tensors
        Of float32, and of bool.
    noise, dimmed
        As `fit.rays.Rays` has them.
    """
    depths = measured if dimmed is None else measured + dimmed
    inputs = [_flat(part) for part in (measured, depths, aside.to(measured.dtype))]
    made = [measured.new_empty(len(inputs[0])).numpy() for _ in range(3)]
    parts = (*inputs, *made, np.float32(noise))
    run_tasks(lambda a, b: _weigh(a, b, *parts), tasks_of_lanes(len(inputs[0])))
    values, fitted, held_out = (_shaped(part, measured) for part in made)
    return values, fitted, held_out


def _flat(rays: torch.Tensor) -> np.ndarray:
    return padded(rays.detach().reshape(-1).numpy())


def _shaped(flat: np.ndarray, like: torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(flat[: like.numel()]).reshape(like.shape)


@njit(nogil=True, cache=True, error_model="numpy")
def _weigh(start, stop, measured, depths, aside, values, fitted, held_out, noise):
    none, one = np.float32(0), np.float32(1)
    zero = halves(none, none)
    for begin in range(start, stop, LANES):
        at = min(begin, len(measured) - LANES)
        value, depth = load(measured, at), load(depths, at)
        # 1 where a number is finite.
        usable = within(value, _LARGEST, zero - value, _LARGEST, zero + one)
        light = within(depth, _OPAQUE, depth, _OPAQUE, power_of_two(larger(depth * _BY_LOG_2, _LEAST)))
        weight = inverse_root(one + smaller(noise * light, _LARGEST))
        weight = usable if noise == none else within(depth, _OPAQUE, zero - usable, -one, weight)
        store(values, at, within(value, _LARGEST, zero - value, _LARGEST, value))
        out = load(aside, at)
        store(fitted, at, weight * (one - out))
        store(held_out, at, weight * out)


def misfit_sums(
    rays: tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor], width: float
) -> tuple[np.ndarray, torch.Tensor]:
    """Sums of losses and of weights, of the fitted rays and then of those held out; slopes of the first by ray.

    Parameters
    ----------
    rays : four float32 tensors
        Predicted, measured, weights of the fitted and of those held out; of one shape.
    width : float
        As `fit.loss.huber_width` gives it.

    Returns
    -------
    (4,) float64 array, tensor of the rays' shape
    """
    inputs = [_flat(part) for part in rays]
    slopes, tasks = rays[0].new_empty(len(inputs[0])).numpy(), tasks_of_lanes(len(inputs[0]))
    sums = np.zeros((len(tasks), 4))
    parts = (*inputs, slopes, np.float32(max(width, _SMALLEST)), sums)
    run_tasks(lambda a, b: _add_up(a, b, *parts), tasks)
    return sums.sum(axis=0), _shaped(slopes, rays[0])


@njit(nogil=True, cache=True, error_model="numpy")
def _add_up(start, stop, predicted, measured, fitted, held_out, slopes, width, sums):
    none, one, half = np.float32(0), np.float32(1), np.float32(0.5)
    by_width, zero, lanes = one / width, halves(none, none), np.empty(4 * LANES, np.float32)
    number = halves(none, np.float32(HALF)) + ramp()
    for first in range(start, stop, _ADDED):
        loss = weights = loss_aside = weights_aside = zero
        for begin in range(first, min(first + _ADDED, stop), LANES):
            at = min(begin, len(predicted) - LANES)
            residual, weight, aside = (
                load(predicted, at) - load(measured, at),
                load(fitted, at),
                load(held_out, at),
            )
            both = weight + aside
            # A ray without weight may have any prediction.
            residual = within(zero - both, -_SMALLEST, zero - both, -_SMALLEST, residual)
            scaled = larger(residual, zero - residual) * both
            near = smaller(scaled, width)
            value = (scaled - half * near) * (near * by_width)
            store(slopes, at, weight * larger(smaller(residual * both * by_width, one), -one))
            # What the block before has counted counts no more.
            new = zero - number, np.float32(at - begin)
            value = within(*new, *new, value)
            weight, aside = within(*new, *new, weight), within(*new, *new, aside)
            loss = loss + within(zero - weight, -_SMALLEST, zero - weight, -_SMALLEST, value)
            loss_aside = loss_aside + within(zero - aside, -_SMALLEST, zero - aside, -_SMALLEST, value)
            weights, weights_aside = weights + weight, weights_aside + aside
        store(lanes, 0, loss)
        store(lanes, LANES, weights)
        store(lanes, 2 * LANES, loss_aside)
        store(lanes, 3 * LANES, weights_aside)
        for k in range(4 * LANES):
            sums[start // TASK, k // LANES] += lanes[k]
