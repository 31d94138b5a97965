"""The slope of the total variation, compiled for the CPU: what `fit.loss.variation_of_slab` has.

A step needs the slope alone. As torch has it, operation by operation, it took a sixth of a small cloud's step. Voxels
stand in one row, in which neighbours along an axis are so far ``apart``.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from tomo_polysplat.compiled import njit
from tomo_polysplat.kernels.numba_lanes import LANES, larger, load, smaller, store, within
from tomo_polysplat.kernels.step.faint import FAINT

__all__ = ["variation_gradient"]

# As a corner, none; and what makes a sign of a difference.
_ENDLESS = np.float32(1e30)


def variation_gradient(
    volume: torch.Tensor,
    away: torch.Tensor | None,
    corners: tuple[float, float],
    dense: float,
    factor: float,
    planes: int,
) -> torch.Tensor:
    """``factor`` times the gradient of the total variation of a volume (nz, ny, nx) of float32, so shaped.

    Of a slab it is that of the whole volume, of so many ``planes``, except within ``faint.HALO`` planes of where the
    slab ends. ``away`` says which voxels are away from edges; None where none is faint.
    """
    whole, shape, plane = (planes, *volume.shape[1:]), volume.shape, math.prod(volume.shape[1:])
    width = FAINT * corners[0] if away is not None else 0.0
    numbers = np.array(
        [
            *(corners if any(corners) else (_ENDLESS, _ENDLESS)),
            # The least number that is dense.
            np.nextafter(np.float32(dense), np.float32(np.inf)),
            -1 / width if width else 0.0,
            0.5 * width,
        ],
        np.float32,
    )
    size = volume.numel()
    values, slopes, gradient = (
        volume.new_zeros(length + LANES).numpy() for length in (size + plane, plane + size, size)
    )
    values[:size].reshape(shape)[:] = volume.numpy()
    near = volume.new_zeros(len(values) if width else 0).numpy()
    if away is not None and width:
        near[:size].reshape(shape)[:] = away.numpy()
    away = None
    inside = slopes[plane : plane + size].reshape(shape)
    # In the order in which autograd adds them up.
    for axis, apart in ((2, 1), (1, shape[2]), (0, plane)):
        if whole[axis] > 1:
            many = math.prod(whole) // whole[axis] * (whole[axis] - 1)
            _slopes(values, near, apart, numbers, np.float32(factor) / np.float32(many), slopes[plane:])
            np.moveaxis(inside, axis, 0)[-1] = 0.0
            _add(slopes, plane, apart, gradient)
    return torch.from_numpy(gradient[:size].reshape(shape))


@njit(nogil=True, cache=True, error_model="numpy")
def _slopes(values, near, apart, numbers, times, slopes):
    """``times`` the slope of what each difference counts."""
    none, one = np.float32(0), np.float32(1)
    corner, dense_corner, dense, by_width, half = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    for k in range(0, len(slopes) - LANES, LANES):
        a, b = load(values, k), load(values, k + apart)
        step = b - a
        height = larger(step, none - step)
        slope = larger(smaller(step * _ENDLESS, one), -one)
        if len(near):
            # Huber's function of d is d - width / 2 (1 - missing^2), and its slope 1 - missing.
            both = load(near, k) * load(near, k + apart)
            missing = larger(height * by_width + one, none) * both
            height = height + (missing * missing - both) * half
            slope = slope * (one - missing)
        least = none - larger(a, b)
        its = corner + within(least, -dense, least, -dense, none * step + (dense_corner - corner))
        store(slopes, k, slope * its / (height + its) * times)


@njit(nogil=True, cache=True, error_model="numpy")
def _add(slopes, first, apart, gradient):
    """Each difference pulls its second voxel up and its first down."""
    for k in range(0, len(slopes) - first - LANES, LANES):
        store(gradient, k, load(gradient, k) + (load(slopes, first + k - apart) - load(slopes, first + k)))
