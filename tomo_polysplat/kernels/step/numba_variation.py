"""The slope of the total variation, compiled for the CPU: what `fit.loss.variation_of_slab` has, to the bit.

A step needs the slope alone. As torch has it, operation by operation, it took a sixth of a small cloud's step.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from tomo_polysplat.compiled import called, njit
from tomo_polysplat.kernels.step.faint import FAINT

__all__ = ["variation_gradient"]

_NOTHING = np.float32(0)


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
    whole, width = (planes, *volume.shape[1:]), FAINT * corners[0] if away is not None else 0.0
    numbers = np.array([*corners, dense, -1 / width if width else 0.0, 0.5 * width], np.float32)
    volume = volume.contiguous()
    near = torch.zeros_like(volume, dtype=torch.bool) if away is None else away.contiguous()
    gradient, slopes = torch.zeros_like(volume), torch.empty_like(volume)
    parts = volume.numpy(), near.numpy(), slopes.numpy(), gradient.numpy()
    # In the order in which autograd adds them up.
    for axis in (2, 1, 0):
        if whole[axis] > 1:
            many = math.prod(whole) // whole[axis] * (whole[axis] - 1)
            times = np.float32(factor) / np.float32(many)
            _add_along(*parts, axis, any(corners), width > 0, numbers, times)
    return gradient


@njit(nogil=True, cache=True, error_model="numpy")
def _add_along(volume, near, slopes, gradient, axis, cornered, faint, numbers, times):
    """Add what the differences along an axis pull each voxel by; each pulls its second one up and its first down."""
    nz, ny, nx = volume.shape
    dz, dy, dx = 1 if axis == 0 else 0, 1 if axis == 1 else 0, 1 if axis == 2 else 0
    for z in range(nz - dz):
        for y in range(ny - dy):
            a, b = volume[z, y, : nx - dx], volume[z + dz, y + dy, dx:]
            one, other = near[z, y, : nx - dx], near[z + dz, y + dy, dx:]
            _slopes(a, b, one, other, cornered, faint, numbers, slopes[z, y])
    for z in range(nz):
        for y in range(ny):
            for x in range(nx):
                before = z >= dz and y >= dy and x >= dx
                behind = z < nz - dz and y < ny - dy and x < nx - dx
                up = slopes[z - dz, y - dy, x - dx] * times if before else _NOTHING
                down = slopes[z, y, x] * times if behind else _NOTHING
                gradient[z, y, x] += up - down


@called(error_model="numpy")
def _slopes(a, b, near_a, near_b, cornered, faint, numbers, out):
    """The slope of what each difference of two rows counts."""
    nothing, one = np.float32(0), np.float32(1)
    corner, dense_corner, dense, by_width, half = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    for x in range(len(a)):
        step = b[x] - a[x]
        height = abs(step)
        slope = (one if step > nothing else nothing) - (one if step < nothing else nothing)
        if cornered:
            if faint:
                # Huber's function of d is d - width / 2 (1 - missing^2), and its slope 1 - missing.
                both = one if near_a[x] and near_b[x] else nothing
                missing = max(height * by_width + one, nothing) * both
                height = height + (missing * missing - both) * half
                slope = slope * (one - missing)
            its = dense_corner if max(a[x], b[x]) > dense else corner
            slope = slope / (height / its + one)
        out[x] = slope
