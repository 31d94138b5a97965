"""Where a Gaussian lies among the voxels, and the way back from there to its gradients, in float64 and a group at once.

Vectors are tuples, which the compiler keeps in registers. README.md derives the formulas.
"""

from __future__ import annotations

import math

import numpy as np

from tomo_polysplat.compiled import njit
from tomo_polysplat.kernels.gaussian_maths import dot, mix, step
from tomo_polysplat.kernels.numba_group import GROUP, SIZE, gaussian_of, put_group, three

__all__ = ["MOMENTS", "NUMBERS", "describe", "pull_back", "set_up"]

NUMBERS = 15  # numbers of a Gaussian, in the order of _described
MOMENTS = 9  # sums over the voxels of a Gaussian, in the order read by _pulled_back


@step
def _triangle(white, spacing):
    """Orthonormal q1, q2, q3 (zero where there is no extent along z) and r11, r12, r13, r22, r23, r33, by threes, so
    that W diag(spacing) = q r. The squared distance of the offset (x, y, z) in voxels is
    (r11 x + r12 y + r13 z)^2 + (r22 y + r23 z)^2 + (r33 z)^2."""
    x, y, z = (
        (white[0][0] * spacing[0], white[1][0] * spacing[0], white[2][0] * spacing[0]),
        (white[0][1] * spacing[1], white[1][1] * spacing[1], white[2][1] * spacing[1]),
        (white[0][2] * spacing[2], white[1][2] * spacing[2], white[2][2] * spacing[2]),
    )
    q1, r11 = _direction(x)
    r12, r13 = dot(q1, y), dot(q1, z)
    y, z = mix(1.0, y, -r12, q1), mix(1.0, z, -r13, q1)
    q2, r22 = _direction(y)
    r23 = dot(q2, z)
    q3, r33 = _direction(mix(1.0, z, -r23, q2))
    return (q1, q2, q3), (r11, r12, r13), (r22, r23, r33)


@step
def _direction(x):
    length = math.sqrt(dot(x, x))
    inverse = 1.0 / length if length > 0.0 else 0.0
    return (x[0] * inverse, x[1] * inverse, x[2] * inverse), length


@step
def _range(centre, spread, length):
    """Half-open range of the indices within ``spread`` of a centre; 0, 0 if there are none."""
    low, high = max(0.0, np.ceil(centre - spread)), min(length - 1.0, np.floor(centre + spread))
    return (low, high + 1.0) if low <= high else (0.0, 0.0)


@step
def _described(point, white, first, spacing, cutoff, nz, nx):
    """The numbers of a Gaussian, by threes: its centre in voxels; r of `_triangle`; the slices that it reaches, a
    two-dimensional one (r33 = 0) all; the columns that it reaches in any row; 1 / r22 and r23 / r22."""
    _, (r11, r12, r13), (r22, r23, r33) = _triangle(white, spacing)
    xc, yc, zc = (
        (point[0] - first[0]) / spacing[0],
        (point[1] - first[1]) / spacing[1],
        (point[2] - first[2]) / spacing[2],
    )
    by_r22 = 1.0 / r22
    # The first row of the inverse of r: its length is the deviation along a row of voxels.
    second = r12 * by_r22
    third = (second * r23 - r13) / r33 if r33 > 0.0 else 0.0
    low, high = _range(zc, cutoff / r33 if r33 > 0.0 else np.inf, nz)
    j0, j1 = _range(xc, cutoff * math.sqrt(1.0 + second * second + third * third) / r11, nx)
    return (xc, yc, zc), (r11, r12, r13), (r22, r23, r33), (low, high, j0), (j1, by_r22, r23 * by_r22)


@njit(inline="always")
def describe(some, first, spacing, cutoff, nz, nx, group, out, record, to):
    """Write the numbers of a group to ``record[to : to + some]``."""
    for k in range(GROUP):
        point, _, white = gaussian_of(group, k)
        numbers = _described(point, white, first, spacing, cutoff, nz, nx)
        for i in range(5):
            for j in range(3):
                out[(3 * i + j) * GROUP + k] = numbers[i][j]
    for k in range(some):
        for i in range(NUMBERS):
            record[to + k, i] = out[i * GROUP + k]


@njit(nogil=True, cache=True, error_model="numpy")
def set_up(start, stop, position, scale, rotation, first, spacing, cutoff, nz, nx, record):
    group, out = np.zeros(SIZE * GROUP), np.empty(NUMBERS * GROUP)
    corner, edges = (first[0], first[1], first[2]), (spacing[0], spacing[1], spacing[2])
    for n in range(start, stop, GROUP):
        some = min(GROUP, stop - n)
        put_group(n, some, position, scale, rotation, group)
        describe(some, corner, edges, cutoff, nz, nx, group, out, record, n)


@step
def _pulled_back(white, spacing, m):
    """dL/dposition and dL/dW, by rows, from the moments ``m`` of h with (t, u, w), (tt, tu, tw) and (uu, uw, ww)."""
    (q1, q2, q3), (r11, r12, r13), (r22, r23, r33) = _triangle(white, spacing)
    (t, u, w), (tt, tu, tw), (uu, uw, ww) = m
    # distance^2 = |q t|^2 and dL/dr(x, y, z) = 2 q sum(h t t^T): solve with r, from z up.
    by_r33 = 2.0 / r33 if r33 > 0.0 else 0.0
    z = mix(by_r33, mix(tw, q1, uw, q2), by_r33 * ww, q3)
    y = mix(1.0 / r22, mix(2 * tu, q1, 2 * uu, q2), 2 * uw / r22, q3)
    y = mix(1.0, y, -r23 / r22, z)
    x = mix(1.0 / r11, mix(2 * tt, q1, 2 * tu, q2), 2 * tw / r11, q3)
    x = mix(1.0, x, -1.0 / r11, mix(r12, y, r13, z))
    ahead = mix(-2.0, mix(t, q1, u, q2), -2 * w, q3)
    point = mix(1.0, mix(ahead[0], white[0], ahead[1], white[1]), ahead[2], white[2])
    hx, hy, hz = spacing
    rows = (
        (x[0] * hx, y[0] * hy, z[0] * hz),
        (x[1] * hx, y[1] * hy, z[1] * hz),
        (x[2] * hx, y[2] * hy, z[2] * hz),
    )
    return point, rows


@njit(inline="always")
def pull_back(spacing, group, moments, grads):
    """Fill ``grads`` with dL/dposition (3) and dL/dW (9) of a group."""
    for k in range(GROUP):
        m = three(moments, 0, k), three(moments, 3, k), three(moments, 6, k)
        point, rows = _pulled_back(gaussian_of(group, k)[2], spacing, m)
        for i in range(3):
            grads[i * GROUP + k] = point[i]
            for j in range(3):
                grads[(3 + 3 * i + j) * GROUP + k] = rows[i][j]
