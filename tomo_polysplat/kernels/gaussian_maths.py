"""Steps shared by the compiled CPU kernels: a Gaussian's value, and its whitening matrix forth and back.

Vectors and matrices are tuples, which the compiler keeps in registers.
"""

from __future__ import annotations

import math

import numpy as np

from tomo_polysplat.compiled import called, njit
from tomo_polysplat.kernels.numba_lanes import power_of_two, within

__all__ = ["FAST", "dot", "gaussian", "mix", "squared", "step", "whitening", "whitening_adjoint"]

# Rounding may be reordered for speed; NaN and infinity keep their meaning (planar Gaussians use infinity).
FAST = {"reassoc", "contract", "arcp", "nsz", "afn"}
# Beyond this square of a distance a Gaussian is below 2e-22, and where it is zero none is too small for a float.
_FARTHEST = np.float32(100)

# For functions inlined by LLVM: where Numba does it, compiling takes a third longer.
step = called(error_model="numpy", fastmath={"contract"}, forceinline=True)


@njit(inline="always")
def squared(cutoff):
    """The square of the distance at which Gaussians end, for `gaussian`."""
    return min(np.float32(cutoff * cutoff), _FARTHEST)


@njit(inline="always")
def gaussian(q, cut, y, bottom, factor):
    """``factor exp(-q / 2)`` of lanes, the exponential within 4e-7 relative, where ``q <= cut`` and ``y <= bottom``,
    else 0."""
    return within(q, cut, y, bottom, power_of_two(q * np.float32(-0.7213475204444817)) * factor)


@step
def dot(a, b):
    """The product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@step
def mix(a, x, b, y):
    """``a x + b y`` of two vectors x and y."""
    return a * x[0] + b * y[0], a * x[1] + b * y[1], a * x[2] + b * y[2]


@step
def _normed(rotation):
    w, x, y, z = rotation
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    by_norm = 1.0 / norm
    return w * by_norm, x * by_norm, y * by_norm, z * by_norm, by_norm


@step
def whitening(scale, rotation):
    """The rows of ``W = diag(1/scale) R^T``; ``rotation`` is a quaternion (w, x, y, z) of any length."""
    w, x, y, z, _ = _normed(rotation)
    a, b, c = 1.0 / scale[0], 1.0 / scale[1], 1.0 / scale[2]
    return (
        (a * (1 - 2 * (y * y + z * z)), a * 2 * (x * y + w * z), a * 2 * (x * z - w * y)),
        (b * 2 * (x * y - w * z), b * (1 - 2 * (x * x + z * z)), b * 2 * (y * z + w * x)),
        (c * 2 * (x * z + w * y), c * 2 * (y * z - w * x), c * (1 - 2 * (x * x + y * y))),
    )


@step
def whitening_adjoint(scale, rotation, white, grad):
    """The gradients of scale (3) and quaternion (4) from ``grad`` = dL/dW, by rows."""
    w, x, y, z, by_norm = _normed(rotation)
    a, b, c = 1.0 / scale[0], 1.0 / scale[1], 1.0 / scale[2]
    # W's row k is R's column k over scale_k, so dW/dscale_k = -W_k / scale_k.
    by_scale = -a * dot(grad[0], white[0]), -b * dot(grad[1], white[1]), -c * dot(grad[2], white[2])
    (g00, g01, g02), (g10, g11, g12), (g20, g21, g22) = grad
    g00, g01, g02 = a * g00, a * g01, a * g02
    g10, g11, g12 = b * g10, b * g11, b * g12
    g20, g21, g22 = c * g20, c * g21, c * g22
    gw = 2 * (z * (g01 - g10) + y * (g20 - g02) + x * (g12 - g21))
    gx = 2 * (y * (g01 + g10) + z * (g02 + g20) + w * (g12 - g21) - 2 * x * (g11 + g22))
    gy = 2 * (x * (g01 + g10) + z * (g12 + g21) + w * (g20 - g02) - 2 * y * (g00 + g22))
    gz = 2 * (x * (g02 + g20) + y * (g12 + g21) + w * (g01 - g10) - 2 * z * (g00 + g11))
    # Only the part across the quaternion counts: its length is normalised away.
    along = gw * w + gx * x + gy * y + gz * z
    by_rotation = (
        (gw - along * w) * by_norm, (gx - along * x) * by_norm,
        (gy - along * y) * by_norm, (gz - along * z) * by_norm,
    )  # fmt: skip
    return by_scale, by_rotation
