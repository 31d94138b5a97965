"""Where a Gaussian falls on the detector, and the way back from there to its gradients.

The way back is in float64, and so are the differences and cross products of the way there, which cancel. What is made
of these is in float32, as are the sums over pixels. Both are long chains of operations that wait for each other, once a
Gaussian and view, and so they run for a group of Gaussians at once (``numba_group``). Vectors are tuples, which the
compiler keeps in registers. README.md derives the formulas.
"""

from __future__ import annotations

import math

import numpy as np

from tomo_polysplat.compiled import njit
from tomo_polysplat.kernels.gaussian_maths import dot, mix, step
from tomo_polysplat.kernels.numba_group import GROUP, SIZE, gaussian_of, put_group, three

__all__ = [
    "MOMENTS",
    "RECORD",
    "ends_of",
    "numbers_of",
    "pull_back",
    "pull_back_view",
    "ray_frame",
    "rows_of",
    "set_up",
]

RECORD = 12  # numbers of a footprint, in the order of _described
MOMENTS = 11  # sums over a footprint, in the order read by pull_back

# As plain numbers they would make float64 of a product.
_NONE, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)


@step
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@step
def _apply(matrix, x):
    return dot(matrix[0], x), dot(matrix[1], x), dot(matrix[2], x)


@step
def _columns(matrix):
    (a, b, c), (d, e, f), (g, h, i) = matrix
    return (a, d, g), (b, e, h), (c, f, i)


@step
def rows_of(matrix):
    """The rows of a (3, 3) array, as tuples."""
    return (
        (matrix[0, 0], matrix[0, 1], matrix[0, 2]),
        (matrix[1, 0], matrix[1, 1], matrix[1, 2]),
        (matrix[2, 0], matrix[2, 1], matrix[2, 2]),
    )


@step
def ray_frame(point, cone, origin, inverse, matrix, white):
    """Column, row and kappa (0 if behind the source) of the centre, the ray r there, W r, W U and W V."""
    r = point[0] - origin[0], point[1] - origin[1], point[2] - origin[2]
    a, b, c = _apply(inverse, r)
    kappa = 1.0
    u, v, along = _columns(matrix)
    if cone:
        kappa = 1.0 / c if c > 0.0 else 0.0
    else:
        r = along
    return (a * kappa, b * kappa, kappa), r, _apply(white, r), _apply(white, u), _apply(white, v)


@step
def _single(x):
    """The vector in float32."""
    return np.float32(x[0]), np.float32(x[1]), np.float32(x[2])


@step
def _triangle(nu, nv):
    """Orthonormal q1, q2, then r11, r12, r22 with ``nv = r11 q1`` and ``nu = r12 q1 + r22 q2``, and 1 / r11, 1 / r22
    (0 where that is none)."""
    q1, r11, by_r11 = _direction(nv)
    r12 = dot(q1, nu)
    q2, r22, by_r22 = _direction((nu[0] - r12 * q1[0], nu[1] - r12 * q1[1], nu[2] - r12 * q1[2]))
    return q1, q2, (r11, r12, r22), (by_r11, by_r22)


@step
def _direction(x):
    length = math.sqrt(dot(x, x))
    inverse = _ONE / length if length > _NONE else _NONE
    return (x[0] * inverse, x[1] * inverse, x[2] * inverse), length, inverse


@step
def _described(cone, planar, cutoff, rows, columns, centre, w, wu, wv):
    """The numbers of a footprint by threes, and its half-open ranges of rows and columns (all 0 if there are none).

    Column0, row0, r11, r12, r22 (the whitened distance is |(r11 y + r12 x, r22 x)| / |e|), then those of
    |e|^2 = n[5] + n[6] x + n[7] y + n[8] x^2 + n[9] x y + n[10] y^2.
    """
    _, _, (r11, r12, r22), _ = _triangle(_single(_cross(w, wu)), _single(_cross(w, wv)))
    column0, row0, kappa = _single(centre)
    if planar:
        row0 = _NONE
    w, wu, wv = _single(w), _single(wu), _single(wv)
    ee = kappa * kappa * dot(w, w)
    eu = ev = uu = uv = vv = _NONE
    if cone:
        eu, ev = kappa * dot(w, wu), kappa * dot(w, wv)
        uu, uv, vv = dot(wu, wu), dot(wu, wv), dot(wv, wv)
    # (distance^2 - cutoff^2) |e|^2 = a x^2 + 2 b x y + c y^2 + 2 d x + 2 f y + g, not positive within the cut.
    cut = np.float32(cutoff * cutoff)
    a, b, c = r12 * r12 + r22 * r22 - cut * uu, r11 * r12 - cut * uv, r11 * r11 - cut * vv
    d, f, g = -cut * eu, -cut * ev, -cut * ee
    if planar:
        i0, i1 = _NONE, _ONE
        j0, j1 = _range(a, d, g, column0, columns)
    else:
        by_a, by_c = _ONE / a, _ONE / c
        i0, i1 = _range(c - b * b * by_a, f - b * d * by_a, g - d * d * by_a, row0, rows)
        j0, j1 = _range(a - b * b * by_c, d - b * f * by_c, g - f * f * by_c, column0, columns)
    numbers = (column0, row0, r11), (r12, r22, ee), (_TWO * eu, _TWO * ev, uu), (_TWO * uv, vv, _NONE)
    some = i1 > _NONE and j1 > _NONE
    return numbers, (
        i0 if some else _NONE,
        i1 if some else _NONE,
        j0 if some else _NONE,
        j1 if some else _NONE,
    )


@step
def _range(square, half, rest, centre, length):
    """Half-open range of the indices i with ``square x^2 + 2 half x + rest <= 0``, x = i - centre; 0, 0 if none."""
    inside, by_square = half * half - square * rest, _ONE / square
    spread, middle = math.sqrt(inside) * by_square, centre - half * by_square
    low, high = max(_NONE, np.ceil(middle - spread)), min(np.float32(length - 1), np.floor(middle + spread))
    some = square > _NONE and inside >= _NONE and low <= high
    return low if some else _NONE, high + _ONE if some else _NONE


@step
def _reach(white, scale, toward):
    """Standard deviation along the axis ``toward``; axes of infinite scale lie across it and do not count."""
    a, b, c = _apply(white, toward)
    a = a * scale[0] * scale[0] if a != 0.0 else 0.0
    b = b * scale[1] * scale[1] if b != 0.0 else 0.0
    c = c * scale[2] * scale[2] if c != 0.0 else 0.0
    return math.sqrt(a * a + b * b + c * c)


@step
def _footprints(cone, planar, cutoff, rows, columns, origin, inverse, matrix, group, out, ends, lost):
    """Fill ``out`` with the numbers of a group in a view, ``ends`` with its ranges, or none for what does not lie
    ahead of the source, and ``lost`` with 1 for that."""
    for k in range(GROUP):
        point, scale, white = gaussian_of(group, k)
        centre, r, w, wu, wv = ray_frame(point, cone, origin, inverse, matrix, white)
        ahead = True
        if cone:
            # A centre behind the source has a negative depth.
            ahead = dot(inverse[2], r) > 1.001 * cutoff * _reach(white, scale, inverse[2])
        numbers, ranges = _described(cone, planar, cutoff, rows, columns, centre, w, wu, wv)
        for i in range(4):
            for j in range(3):
                out[(3 * i + j) * GROUP + k] = numbers[i][j]
            ends[i * GROUP + k] = np.int32(ranges[i]) if ahead else np.int32(0)
        lost[k] = np.int32(0) if ahead else np.int32(1)


@njit(nogil=True, cache=True, error_model="numpy")
def set_up(
    start, stop, position, scale, rotation, cone, planar, origin, inverse, matrix, cutoff, rows, columns, record, span
):  # fmt: skip
    """Footprints of the groups start..stop in every view; returns how many reach a source plane.

    ``record`` (views, groups, RECORD x GROUP) float32 and ``span`` (views, groups, 4 x GROUP) int32 are filled: number
    i of Gaussian k of a group stands at ``i * GROUP + k``.
    """
    group, lost = np.zeros(SIZE * GROUP), np.empty(GROUP, np.int32)
    skipped = 0
    for g in range(start, stop):
        some = min(GROUP, len(position) - g * GROUP)
        put_group(g * GROUP, some, position, scale, rotation, group)
        for v in range(len(origin)):
            place = origin[v, 0], origin[v, 1], origin[v, 2]
            inverted, direct = rows_of(inverse[v]), rows_of(matrix[v])
            out, ends = record[v, g], span[v, g]
            _footprints(cone, planar, cutoff, rows, columns, place, inverted, direct, group, out, ends, lost)
            for k in range(some):
                skipped += lost[k]
    return skipped


@njit(inline="always")
def numbers_of(a, k):
    """The numbers of a footprint of a group as a tuple: an array would be read again after every store to another."""
    return (*three(a, 0, k), *three(a, 3, k), *three(a, 6, k), *three(a, 9, k))


@njit(inline="always")
def ends_of(a, k):
    """Its half-open ranges of rows and of columns."""
    return (*three(a, 0, k), a[3 * GROUP + k])


@step
def _slopes(cone, planar, frame, m):
    """dL/d(column, row, depth) of the centre and dL/d(W r), dL/d(W U), dL/d(W V), from moments of a footprint.

    With t = r11 y + r12 x and u = r22 x, m holds the sums of h (t, u, t^2, t u, u^2) and of
    s (1, t, u, t^2, t u, u^2), where h = dL/d(distance^2 |e|^2) and s = dL/d|e|^2. What
    cancels, as of the rotation of a round Gaussian, has to: of what rounding leaves Adam makes full steps.
    """
    centre, _, w, wu, wv = frame
    (m0, m1, m2), (m3, m4, m5), (m6, m7, m8), (m9, m10, _) = m
    q1, q2, (r11, r12, r22), (by_t, by_u) = _triangle(_cross(w, wu), _cross(w, wv))
    column0, row0, kappa = centre
    # y = by_t t - back u, x = by_u u.
    back = by_t * r12 * by_u
    sum_t, sum_u = mix(m2, q1, m3, q2), mix(m3, q1, m4, q2)
    g_nv, g_nu = mix(_TWO * by_t, sum_t, -_TWO * back, sum_u), mix(_TWO * by_u, sum_u, _NONE, sum_u)
    g_row, g_column = -_TWO * r11 * m0, -_TWO * (r12 * m0 + r22 * m1)
    # nu = w x WU and nv = w x WV.
    g_wu, g_wv = _cross(g_nu, w), _cross(g_nv, w)
    g_w = mix(_ONE, _cross(wu, g_nu), _ONE, _cross(wv, g_nv))
    g_depth = _NONE
    if cone:
        # e = e0 + t et + u eu.
        e0, et, eu = mix(kappa, w, _NONE, w), mix(by_t, wv, _NONE, wv), mix(by_u, wu, -back, wv)
        g_e = mix(_TWO, mix(m5, e0, m6, et), _TWO * m7, eu)
        sum_t = mix(_ONE, mix(m6, e0, m8, et), m9, eu)
        sum_u = mix(_ONE, mix(m7, e0, m9, et), m10, eu)
        g_wv = mix(_ONE, g_wv, _ONE, mix(_TWO * by_t, sum_t, -_TWO * back, sum_u))
        g_wu = mix(_ONE, g_wu, _TWO * by_u, sum_u)
        g_w = mix(_ONE, g_w, kappa, g_e)
        g_column -= dot(g_e, wu)
        g_row = _NONE if planar else g_row - dot(g_e, wv)
        g_depth = -kappa * (g_column * column0 + g_row * row0 + kappa * dot(g_e, w))
    else:
        g_row = _NONE if planar else g_row
        g_w = mix(_ONE, g_w, _TWO * m5, w)
    return (kappa * g_column, kappa * g_row, g_depth), g_w, g_wu, g_wv


@step
def pull_back(cone, planar, frame, inverse, matrix, white, m):
    """dL/dposition (3) and dL/dW (9, row by row) of one view, from the moments ``m`` of its footprint."""
    (g_column, g_row, g_depth), g_w, g_wu, g_wv = _slopes(cone, planar, frame, m)
    if cone:
        point = mix(g_w[0], white[0], g_w[1], white[1])
        point = mix(1.0, point, g_w[2], white[2])
        point = mix(1.0, point, g_column, inverse[0])
        point = mix(1.0, point, g_row, inverse[1])
        point = mix(1.0, point, g_depth, inverse[2])
    else:
        point = mix(g_column, inverse[0], g_row, inverse[1])
    u, v, _ = _columns(matrix)
    r = frame[1]
    rows = (
        mix(1.0, mix(g_w[0], r, g_wu[0], u), g_wv[0], v),
        mix(1.0, mix(g_w[1], r, g_wu[1], u), g_wv[1], v),
        mix(1.0, mix(g_w[2], r, g_wu[2], u), g_wv[2], v),
    )
    return point, rows


@step
def _back(white, x):
    """W^T x."""
    return mix(1.0, mix(x[0], white[0], x[1], white[1]), x[2], white[2])


@step
def pull_back_view(cone, planar, point, frame, origin, inverse, white, m):
    """dL/d(origin, U, V, D) of a view, as far as the Gaussian at ``point`` makes it, from its moments ``m``.

    The image of the offset p - o under the inverse is (a, b, c), and that of dL/d(a, b, c) under its transpose is t:
    then the inverse's part of dL/d(U, V, D) is -(a, b, c) t.
    """
    (g_column, g_row, g_depth), g_w, g_wu, g_wv = _slopes(cone, planar, frame, m)
    t = mix(1.0, mix(g_column, inverse[0], g_row, inverse[1]), g_depth, inverse[2])
    a, b, c = _apply(inverse, (point[0] - origin[0], point[1] - origin[1], point[2] - origin[2]))
    along, by_u, by_v = _back(white, g_w), _back(white, g_wu), _back(white, g_wv)
    # w is W (p - o) in a cone, and W D where rays are parallel.
    by_origin = mix(-1.0, t, -1.0 if cone else 0.0, along)
    return by_origin, mix(1.0, by_u, -a, t), mix(1.0, by_v, -b, t), mix(0.0 if cone else 1.0, along, -c, t)
