"""Where a Gaussian falls on the detector, and the way back from there to its gradients, in float64.

Both run once a Gaussian and view. Vectors are tuples, which the compiler keeps in registers. README.md derives
the formulas.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tomo_polysplat.kernels.gaussian_maths import whitening

__all__ = ["MOMENTS", "RECORD", "pull_back", "ray_frame", "set_up"]

RECORD = 12  # numbers of a footprint, in the order written by _describe
MOMENTS = 11  # sums over a footprint, in the order read by pull_back

_step = njit(error_model="numpy", inline="always")


@_step
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@_step
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@_step
def _mix(a, x, b, y):
    return a * x[0] + b * y[0], a * x[1] + b * y[1], a * x[2] + b * y[2]


@_step
def _apply(matrix, x):
    return (
        matrix[0, 0] * x[0] + matrix[0, 1] * x[1] + matrix[0, 2] * x[2],
        matrix[1, 0] * x[0] + matrix[1, 1] * x[1] + matrix[1, 2] * x[2],
        matrix[2, 0] * x[0] + matrix[2, 1] * x[1] + matrix[2, 2] * x[2],
    )


@_step
def _column(matrix, k):
    return matrix[0, k], matrix[1, k], matrix[2, k]


@_step
def ray_frame(position, cone, origin, inverse, matrix, white, n, v):
    """Column, row and kappa (0 if behind the source) of the centre, the ray r there, W r, W U and W V."""
    r = position[n, 0] - origin[v, 0], position[n, 1] - origin[v, 1], position[n, 2] - origin[v, 2]
    a, b, c = _apply(inverse[v], r)
    kappa = 1.0
    if cone:
        kappa = 1.0 / c if c > 0.0 else 0.0
    else:
        r = _column(matrix[v], 2)
    u, v_ = _column(matrix[v], 0), _column(matrix[v], 1)
    return (a * kappa, b * kappa, kappa), r, _apply(white, r), _apply(white, u), _apply(white, v_)


@_step
def _triangle(nu, nv):
    """Orthonormal q1, q2 and r11, r12, r22 with ``nu = r11 q1`` and ``nv = r12 q1 + r22 q2``."""
    r11 = math.sqrt(_dot(nu, nu))
    by_r11 = 1.0 / r11 if r11 > 0.0 else 0.0
    q1 = nu[0] * by_r11, nu[1] * by_r11, nu[2] * by_r11
    r12 = _dot(q1, nv)
    rest = _mix(1.0, nv, -r12, q1)
    r22 = math.sqrt(_dot(rest, rest))
    by_r22 = 1.0 / r22 if r22 > 0.0 else 0.0
    return q1, (rest[0] * by_r22, rest[1] * by_r22, rest[2] * by_r22), r11, r12, r22


@_step
def _describe(cone, planar, cutoff, rows, columns, centre, w, wu, wv, rec, span):
    """Fill ``rec``, and ``span`` with the half-open ranges of rows and columns (all 0 if there are none).

    rec: column0, row0, r11, r12, r22 (the whitened distance is |(r11 x + r12 y, r22 y)| / |e|), the
    coefficients of |e|^2 = rec[5] + 2 (rec[6] x + rec[7] y) + rec[8] x^2 + 2 rec[9] x y + rec[10] y^2, r12 / r11.
    """
    _, _, r11, r12, r22 = _triangle(_cross(w, wu), _cross(w, wv))
    kappa = centre[2]
    ee = kappa * kappa * _dot(w, w)
    eu = ev = uu = uv = vv = 0.0
    if cone:
        eu, ev = kappa * _dot(w, wu), kappa * _dot(w, wv)
        uu, uv, vv = _dot(wu, wu), _dot(wu, wv), _dot(wv, wv)
    row0 = 0.0 if planar else centre[1]
    rec[0], rec[1], rec[2], rec[3], rec[4] = centre[0], row0, r11, r12, r22
    rec[5], rec[6], rec[7], rec[8], rec[9], rec[10], rec[11] = ee, eu, ev, uu, uv, vv, r12 / r11
    # (distance^2 - cutoff^2) |e|^2 = a x^2 + 2 b x y + c y^2 + 2 d x + 2 f y + g, not positive within the cut.
    cut = cutoff * cutoff
    a, b, c = r11 * r11 - cut * uu, r11 * r12 - cut * uv, r12 * r12 + r22 * r22 - cut * vv
    d, f, g = -cut * eu, -cut * ev, -cut * ee
    if planar:
        span[0], span[1] = 0, 1
        span[2], span[3] = _range(a, d, g, centre[0], columns)
    else:
        span[0], span[1] = _range(c - b * b / a, f - b * d / a, g - d * d / a, row0, rows)
        span[2], span[3] = _range(a - b * b / c, d - b * f / c, g - f * f / c, centre[0], columns)
    if span[1] == 0 or span[3] == 0:
        span[0] = span[1] = span[2] = span[3] = 0


@_step
def _range(square, half, rest, centre, length):
    """Half-open range of the indices i with ``square x^2 + 2 half x + rest <= 0``, x = i - centre."""
    inside = half * half - square * rest
    if not (square > 0.0 and inside >= 0.0):
        return 0, 0
    spread, middle = math.sqrt(inside) / square, centre - half / square
    low, high = max(0.0, np.ceil(middle - spread)), min(length - 1.0, np.floor(middle + spread))
    return (int(low), int(high) + 1) if low <= high else (0, 0)


@_step
def _reach(white, scale, n, toward):
    """Standard deviation along the axis ``toward``; axes of infinite scale lie across it and do not count."""
    total = 0.0
    for a in range(3):
        turned = white[a, 0] * toward[0] + white[a, 1] * toward[1] + white[a, 2] * toward[2]
        if turned != 0.0:
            total += (turned * scale[n, a] * scale[n, a]) ** 2
    return math.sqrt(total)


@njit(nogil=True, cache=True, error_model="numpy")
def set_up(
    start, stop, position, scale, rotation, cone, planar, origin, inverse, matrix, cutoff, rows, columns, record, span
):  # fmt: skip
    """Footprints of the Gaussians start..stop in every view; returns how many reach a source plane."""
    white = np.empty((3, 3))
    skipped = 0
    for n in range(start, stop):
        whitening(scale, rotation, n, white)
        for v in range(len(origin)):
            centre, _, w, wu, wv = ray_frame(position, cone, origin, inverse, matrix, white, n, v)
            toward = inverse[v, 2, 0], inverse[v, 2, 1], inverse[v, 2, 2]
            depth = 1.0 / centre[2] if centre[2] > 0.0 else 0.0
            if cone and not depth > 1.001 * cutoff * _reach(white, scale, n, toward):
                skipped += 1
                for k in range(4):
                    span[v, n, k] = 0
            else:
                _describe(cone, planar, cutoff, rows, columns, centre, w, wu, wv, record[v, n], span[v, n])
    return skipped


@_step
def pull_back(cone, planar, frame, inverse, matrix, white, m, grad_point, grad_white):
    """Add dL/dposition and dL/dW of one view, from the moments ``m`` of its footprint.

    With t = r11 x + r12 y and u = r22 y, m holds the sums of h (t, u, t^2, t u, u^2) and of
    s (1, t, u, t^2, t u, u^2), where h = dL/d(distance^2 |e|^2) and s = dL/d|e|^2.
    """
    (column0, row0, kappa), r, w, wu, wv = frame
    q1, q2, r11, r12, r22 = _triangle(_cross(w, wu), _cross(w, wv))
    # x = by_t t - back u, y = by_u u.
    by_t, by_u = 1.0 / r11, 1.0 / r22 if r22 > 0.0 else 0.0
    back = by_t * r12 * by_u
    sum_t, sum_u = _mix(m[2], q1, m[3], q2), _mix(m[3], q1, m[4], q2)
    g_nu, g_nv = _mix(2 * by_t, sum_t, -2 * back, sum_u), _mix(2 * by_u, sum_u, 0.0, sum_u)
    g_column, g_row = -2 * r11 * m[0], -2 * (r12 * m[0] + r22 * m[1])
    # nu = w x WU and nv = w x WV.
    g_wu, g_wv = _cross(g_nu, w), _cross(g_nv, w)
    g_w = _mix(1.0, _cross(wu, g_nu), 1.0, _cross(wv, g_nv))
    if cone:
        # e = e0 + t et + u eu.
        e0, et, eu = _mix(kappa, w, 0.0, w), _mix(by_t, wu, 0.0, wu), _mix(by_u, wv, -back, wu)
        g_e = _mix(2.0, _mix(m[5], e0, m[6], et), 2 * m[7], eu)
        sum_t = _mix(1.0, _mix(m[6], e0, m[8], et), m[9], eu)
        sum_u = _mix(1.0, _mix(m[7], e0, m[9], et), m[10], eu)
        g_wu = _mix(1.0, g_wu, 1.0, _mix(2 * by_t, sum_t, -2 * back, sum_u))
        g_wv = _mix(1.0, g_wv, 2 * by_u, sum_u)
        g_w = _mix(1.0, g_w, kappa, g_e)
        g_column -= _dot(g_e, wu)
        g_row = 0.0 if planar else g_row - _dot(g_e, wv)
        g_depth = -kappa * (g_column * column0 + g_row * row0 + kappa * _dot(g_e, w))
        for b in range(3):
            grad_point[b] += white[0, b] * g_w[0] + white[1, b] * g_w[1] + white[2, b] * g_w[2]
            grad_point[b] += (
                kappa * (g_column * inverse[0, b] + g_row * inverse[1, b]) + g_depth * inverse[2, b]
            )
    else:
        g_row = 0.0 if planar else g_row
        g_w = _mix(1.0, g_w, 2 * m[5], w)
        for b in range(3):
            grad_point[b] += g_column * inverse[0, b] + g_row * inverse[1, b]
    for a in range(3):
        for b in range(3):
            grad_white[a, b] += g_w[a] * r[b] + g_wu[a] * matrix[b, 0] + g_wv[a] * matrix[b, 1]
