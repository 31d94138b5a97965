"""Scalar steps shared by the compiled CPU kernels: scale and rotation to the whitening matrix, and back."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.compiled import called, njit

__all__ = ["FAST", "gaussian", "whitening", "whitening_adjoint"]

# Rounding may be reordered for speed; NaN and infinity keep their meaning (planar Gaussians use infinity).
FAST = {"reassoc", "contract", "arcp", "nsz", "afn"}


@njit(inline="always")
def gaussian(q, cut):
    """``exp(-q / 2)`` in float32 within 2e-7 relative for 0 <= q <= cut, else 0; written so that it vectorises.

    2^t is split into an integer, set directly as the float's exponent, and a fraction in [-1/2, 1/2] whose
    power is a Taylor polynomial of degree 6. Beyond q = 100 the result stays at 2e-22, since subnormal numbers
    would be slow.
    """
    deepest = cut if cut < np.float32(100) else np.float32(100)
    t = (q if q < deepest else deepest) * np.float32(-0.7213475204444817)
    whole = np.int32(t - np.float32(0.5))
    f = (t - np.float32(whole)) * np.float32(0.6931471805599453)
    p = np.float32(1 / 720)
    p = p * f + np.float32(1 / 120)
    p = p * f + np.float32(1 / 24)
    p = p * f + np.float32(1 / 6)
    p = p * f + np.float32(0.5)
    p = p * f + np.float32(1.0)
    p = p * f + np.float32(1.0)
    power = p * np.int32((whole + np.int32(127)) << np.int32(23)).view(np.float32)
    return power if q <= cut else np.float32(0)


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
