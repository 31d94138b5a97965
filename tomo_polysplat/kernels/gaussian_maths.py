"""Scalar steps shared by the compiled CPU kernels: scale and rotation to the whitening matrix, and back."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.compiled import called, njit
from tomo_polysplat.kernels.numba_lanes import power_of_two, within

__all__ = ["FAST", "gaussian", "squared", "whitening", "whitening_adjoint"]

# Rounding may be reordered for speed; NaN and infinity keep their meaning (planar Gaussians use infinity).
FAST = {"reassoc", "contract", "arcp", "nsz", "afn"}


# Beyond this square of a distance a Gaussian is below 2e-22, and where it is zero none is too small for a float.
_FARTHEST = np.float32(100)


@njit(inline="always")
def squared(cutoff):
    """The square of the distance at which Gaussians end, for `gaussian`."""
    return min(np.float32(cutoff * cutoff), _FARTHEST)


@njit(inline="always")
def gaussian(q, cut, factor):
    """``factor exp(-q / 2)`` of lanes, the exponential within 4e-7 relative, where ``q <= cut``, else 0."""
    return within(q, cut, power_of_two(q * np.float32(-0.7213475204444817)) * factor)


@njit(inline="always")
def whitening(scale, rotation, n, out):
    """Fill ``out`` (3, 3) float64 with ``W = diag(1/scale) R^T`` of Gaussian ``n``."""
    w, x, y, z = rotation[n, 0], rotation[n, 1], rotation[n, 2], rotation[n, 3]
    norm = np.sqrt(float(w) * w + float(x) * x + float(y) * y + float(z) * z)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    a, b, c = 1.0 / float(scale[n, 0]), 1.0 / float(scale[n, 1]), 1.0 / float(scale[n, 2])
    out[0, 0] = a * (1 - 2 * (y * y + z * z))
    out[0, 1] = a * 2 * (x * y + w * z)
    out[0, 2] = a * 2 * (x * z - w * y)
    out[1, 0] = b * 2 * (x * y - w * z)
    out[1, 1] = b * (1 - 2 * (x * x + z * z))
    out[1, 2] = b * 2 * (y * z + w * x)
    out[2, 0] = c * 2 * (x * z + w * y)
    out[2, 1] = c * 2 * (y * z - w * x)
    out[2, 2] = c * (1 - 2 * (x * x + y * y))


# Inlined by LLVM, which compiles sooner than where Numba does it.
@called(fastmath=FAST, error_model="numpy", forceinline=True)
def whitening_adjoint(scale, rotation, n, white, grad, grad_scale, grad_rotation):
    """Write the gradients of scale and quaternion of Gaussian ``n`` from ``grad`` = dL/dW (3, 3)."""
    w, x, y, z = rotation[n, 0], rotation[n, 1], rotation[n, 2], rotation[n, 3]
    norm = np.sqrt(float(w) * w + float(x) * x + float(y) * y + float(z) * z)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    for k in range(3):
        inverse = 1.0 / float(scale[n, k])
        # W's row k is R's column k over scale_k, so dW/dscale_k = -W_k / scale_k.
        grad_scale[n, k] = -inverse * (
            grad[k, 0] * white[k, 0] + grad[k, 1] * white[k, 1] + grad[k, 2] * white[k, 2]
        )
        grad[k, 0] *= inverse
        grad[k, 1] *= inverse
        grad[k, 2] *= inverse
    g = grad
    gw = 2 * (z * (g[0, 1] - g[1, 0]) + y * (g[2, 0] - g[0, 2]) + x * (g[1, 2] - g[2, 1]))
    gx = 2 * (
        y * (g[0, 1] + g[1, 0])
        + z * (g[0, 2] + g[2, 0])
        + w * (g[1, 2] - g[2, 1])
        - 2 * x * (g[1, 1] + g[2, 2])
    )
    gy = 2 * (
        x * (g[0, 1] + g[1, 0])
        + z * (g[1, 2] + g[2, 1])
        + w * (g[2, 0] - g[0, 2])
        - 2 * y * (g[0, 0] + g[2, 2])
    )
    gz = 2 * (
        x * (g[0, 2] + g[2, 0])
        + y * (g[1, 2] + g[2, 1])
        + w * (g[0, 1] - g[1, 0])
        - 2 * z * (g[0, 0] + g[1, 1])
    )
    # Only the part across the quaternion counts: its length is normalised away.
    along = gw * w + gx * x + gy * y + gz * z
    grad_rotation[n, 0] = (gw - along * w) / norm
    grad_rotation[n, 1] = (gx - along * x) / norm
    grad_rotation[n, 2] = (gy - along * y) / norm
    grad_rotation[n, 3] = (gz - along * z) / norm
