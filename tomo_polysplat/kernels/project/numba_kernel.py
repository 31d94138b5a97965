"""The projection of Gaussians and its adjoint, compiled for the CPU. README.md derives the formulas.

The forward shares out the images (each band of rows of each view is written by one thread) and the backward
the Gaussians, so neither needs atomics and both give the same bits on every run.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tomo_polysplat.kernels.gaussian_maths import FAST, exp_negative, whitening, whitening_adjoint
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.parallel import cpu_threads, run_tasks, split_range

__all__ = ["backward", "forward"]

_LANES = 16  # pixels of a row handled together; images are padded so that a block may run past the row's end
_RECORD = 12  # numbers of a footprint, in the order written by _footprint


@njit(inline="always")
def _chain(position, cone, origin, inverse, matrix, white, n, v, vec):
    """Fill ``vec`` (8, 3) with r, w, WU, WV, nu, nv, e_centre and (column0, row0, kappa); False if behind."""
    for a in range(3):
        vec[0, a] = position[n, a] - origin[v, a]
    alpha = inverse[v, 0, 0] * vec[0, 0] + inverse[v, 0, 1] * vec[0, 1] + inverse[v, 0, 2] * vec[0, 2]
    beta = inverse[v, 1, 0] * vec[0, 0] + inverse[v, 1, 1] * vec[0, 1] + inverse[v, 1, 2] * vec[0, 2]
    gamma = inverse[v, 2, 0] * vec[0, 0] + inverse[v, 2, 1] * vec[0, 1] + inverse[v, 2, 2] * vec[0, 2]
    if cone:
        if not gamma > 0.0:
            return False
        vec[7, 2] = 1.0 / gamma
    else:
        vec[7, 2] = 1.0
        for a in range(3):
            vec[0, a] = matrix[v, a, 2]
    vec[7, 0] = alpha * vec[7, 2]
    vec[7, 1] = beta * vec[7, 2]
    for a in range(3):
        vec[1, a] = white[a, 0] * vec[0, 0] + white[a, 1] * vec[0, 1] + white[a, 2] * vec[0, 2]
        vec[2, a] = (
            white[a, 0] * matrix[v, 0, 0] + white[a, 1] * matrix[v, 1, 0] + white[a, 2] * matrix[v, 2, 0]
        )
        vec[3, a] = (
            white[a, 0] * matrix[v, 0, 1] + white[a, 1] * matrix[v, 1, 1] + white[a, 2] * matrix[v, 2, 1]
        )
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        vec[4, a] = vec[1, b] * vec[2, c] - vec[1, c] * vec[2, b]
        vec[5, a] = vec[1, b] * vec[3, c] - vec[1, c] * vec[3, b]
        vec[6, a] = vec[7, 2] * vec[1, a]
    return True


@njit(inline="always")
def _dot(vec, a, b):
    return vec[a, 0] * vec[b, 0] + vec[a, 1] * vec[b, 1] + vec[a, 2] * vec[b, 2]


@njit(inline="always")
def _footprint(cone, planar, cutoff, rows, vec, rec):
    """Fill ``rec`` and return the half-open range of detector rows; empty ranges are (0, 0).

    rec: column0, row0, r11, r12, r22 (the whitened distance is |(r11 x + r12 y, r22 y)| / |e|) and the
    coefficients of |e|^2 = rec[5] + 2 (rec[6] x + rec[7] y) + rec[8] x^2 + 2 rec[9] x y + rec[10] y^2.
    """
    rec[0], rec[1] = vec[7, 0], vec[7, 1]
    r11 = math.sqrt(_dot(vec, 4, 4))
    if not r11 > 0.0:
        return 0, 0
    r12 = _dot(vec, 4, 5) / r11
    x = vec[4, 1] * vec[5, 2] - vec[4, 2] * vec[5, 1]
    y = vec[4, 2] * vec[5, 0] - vec[4, 0] * vec[5, 2]
    z = vec[4, 0] * vec[5, 1] - vec[4, 1] * vec[5, 0]
    r22 = math.sqrt(x * x + y * y + z * z) / r11
    rec[2], rec[3], rec[4] = r11, r12, r22
    rec[5] = _dot(vec, 6, 6)
    for k in range(6, _RECORD):
        rec[k] = 0.0
    if cone:
        rec[6], rec[7] = _dot(vec, 6, 2), _dot(vec, 6, 3)
        rec[8], rec[9], rec[10] = _dot(vec, 2, 2), _dot(vec, 2, 3), _dot(vec, 3, 3)
    if planar:
        rec[1] = 0.0
        return 0, 1
    # The rows reached are where the discriminant over a row of distance^2 - cutoff^2 |e|^2 is not negative.
    cut = cutoff * cutoff
    a = r11 * r11 - cut * rec[8]
    b0, b1 = -cut * rec[6], r11 * r12 - cut * rec[9]
    c0, c1, c2 = -cut * rec[5], -2 * cut * rec[7], r12 * r12 + r22 * r22 - cut * rec[10]
    lead, half, rest = b1 * b1 - a * c2, b0 * b1 - 0.5 * a * c1, b0 * b0 - a * c0
    inside = half * half - lead * rest
    if not (a > 0.0 and lead < 0.0 and inside > 0.0):
        return 0, 0
    middle, spread = rec[1] - half / lead, -math.sqrt(inside) / lead
    low = max(0.0, math.ceil(middle - spread))
    high = min(rows - 1.0, math.floor(middle + spread))
    if not low <= high:
        return 0, 0
    return int(low), int(high) + 1


@njit(inline="always")
def _columns(rec, y, cut, columns):
    """Half-open range of the columns inside the cut ellipse on the row ``y`` below the centre."""
    r11, r12, r22 = rec[2], rec[3], rec[4]
    a = r11 * r11 - cut * rec[8]
    b = r11 * r12 * y - cut * (rec[6] + rec[9] * y)
    c = (r12 * r12 + r22 * r22) * y * y - cut * (rec[5] + 2 * rec[7] * y + rec[10] * y * y)
    inside = b * b - a * c
    if not (inside > 0.0 and a > 0.0):
        return 0, 0
    spread = math.sqrt(inside) / a
    middle = rec[0] - b / a
    low = max(0.0, math.ceil(middle - spread))
    high = min(columns - 1.0, math.floor(middle + spread))
    if not low <= high:
        return 0, 0
    return int(low), int(high) + 1


@njit(nogil=True, cache=True, error_model="numpy")
def _set_up(
    start, stop, position, scale, rotation, cone, planar, origin, inverse, matrix, cutoff, rows, record, span
):
    """Footprints of the Gaussians start..stop in every view; returns how many reach a source plane."""
    white, vec, rec = np.empty((3, 3)), np.empty((8, 3)), np.empty(_RECORD)
    skipped = 0
    for n in range(start, stop):
        whitening(scale, rotation, n, white)
        for v in range(len(origin)):
            span[v, n, 0] = span[v, n, 1] = 0
            ahead = _chain(position, cone, origin, inverse, matrix, white, n, v, vec)
            if ahead and cone:
                reach = 0.0
                for a in range(3):
                    turned = (
                        white[a, 0] * inverse[v, 2, 0]
                        + white[a, 1] * inverse[v, 2, 1]
                        + white[a, 2] * inverse[v, 2, 2]
                    )
                    if turned != 0.0:
                        reach += (turned * scale[n, a] * scale[n, a]) ** 2
                ahead = 1.001 * cutoff * math.sqrt(reach) * vec[7, 2] < 1.0
            if not ahead:
                skipped += 1
                continue
            span[v, n, 0], span[v, n, 1] = _footprint(cone, planar, cutoff, rows, vec, rec)
            for k in range(_RECORD):
                record[v, n, k] = rec[k]
    return skipped


@njit(inline="always")
def _block(x0, r11, across, up2, e0, e1, e2, cut, value):
    """``exp(-distance^2 / 2) / |e|`` of the pixels x0, x0 + 1, ... of one row, zero beyond the cut."""
    for k in range(_LANES):
        x = np.float32(k) + x0
        t = r11 * x + across
        inverse = np.float32(1) / (e0 + x * (e1 + x * e2))
        q = (t * t + up2) * inverse
        f = exp_negative(np.float32(-0.5) * (q if q < cut else cut)) * np.sqrt(inverse)
        value[k] = f if q <= cut else np.float32(0)


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def _splat(v, first, last, record, span, weight, cutoff, columns, image):
    """Add every footprint to the rows first..last of view ``v`` of ``image`` (views, rows, channels, padded)."""
    cut = np.float32(cutoff * cutoff)
    two = np.float32(2)
    value = np.empty(_LANES, np.float32)
    for n in range(record.shape[1]):
        low, high = max(first, span[v, n, 0]), min(last, span[v, n, 1])
        if low >= high:
            continue
        rec = record[v, n]
        # Locals, not array reads, inside the row: only then does the compiler vectorise it.
        x0, y0, r11, r12, r22, ex, exx = rec[0], rec[1], rec[2], rec[3], rec[4], rec[6], rec[8]
        for i in range(low, high):
            y = np.float32(i) - y0
            j0, j1 = _columns(rec, y, cut, columns)
            across, up2 = r12 * y, (r22 * y) * (r22 * y)
            e0, e1 = rec[5] + y * (two * rec[7] + y * rec[10]), two * (ex + rec[9] * y)
            for j in range(j0, j1, _LANES):
                _block(np.float32(j) - x0, r11, across, up2, e0, e1, exx, cut, value)
                for c in range(len(weight)):
                    w = weight[c, n]
                    line = image[v, i, c, j : j + _LANES]
                    for k in range(_LANES):
                        line[k] += w * value[k]


@njit(inline="always")
def _add_moments(x0, y, r11, across, up2, e0, e1, e2, value, total, acc):
    """Add h and s of one block, times (1, x, y, x^2, xy, y^2), to ``acc``, one lane sum after the other."""
    half, one = np.float32(0.5), np.float32(1)
    for k in range(_LANES):
        x = np.float32(k) + x0
        t = r11 * x + across
        inverse = one / (e0 + x * (e1 + x * e2))
        h = -half * total[k] * value[k] * inverse
        s = h * (one - (t * t + up2) * inverse)
        acc[0 * _LANES + k] += h
        acc[1 * _LANES + k] += h * x
        acc[2 * _LANES + k] += h * y
        acc[3 * _LANES + k] += h * x * x
        acc[4 * _LANES + k] += h * x * y
        acc[5 * _LANES + k] += h * y * y
        acc[6 * _LANES + k] += s
        acc[7 * _LANES + k] += s * x
        acc[8 * _LANES + k] += s * y
        acc[9 * _LANES + k] += s * x * x
        acc[10 * _LANES + k] += s * x * y
        acc[11 * _LANES + k] += s * y * y


@njit(inline="always")
def _gather(
    v, n, record, span, weight, cutoff, columns, grad_image, value, total, sums, acc, moments, grad_weight
):  # fmt: skip
    """Sums over the footprint of Gaussian ``n`` in view ``v``: of dL/df f by channel, and of h and s times
    the monomials (1, x, y, x^2, xy, y^2), with h = dL/d(distance^2 |e|^2) and s = dL/d|e|^2."""
    cut = np.float32(cutoff * cutoff)
    two = np.float32(2)
    rec = record[v, n]
    x0, y0, r11, r12, r22, ex, exx = rec[0], rec[1], rec[2], rec[3], rec[4], rec[6], rec[8]
    channels = len(weight)
    sums[:] = np.float32(0)
    acc[:] = np.float32(0)
    for i in range(span[v, n, 0], span[v, n, 1]):
        y = np.float32(i) - y0
        j0, j1 = _columns(rec, y, cut, columns)
        across, up2 = r12 * y, (r22 * y) * (r22 * y)
        e0, e1 = rec[5] + y * (two * rec[7] + y * rec[10]), two * (ex + rec[9] * y)
        for j in range(j0, j1, _LANES):
            _block(np.float32(j) - x0, r11, across, up2, e0, e1, exx, cut, value)
            total[:] = np.float32(0)
            for c in range(channels):
                w = weight[c, n]
                line = grad_image[v, i, c, j : j + _LANES]
                channel = sums[c]
                for k in range(_LANES):
                    channel[k] += line[k] * value[k]
                    total[k] += w * line[k]
            _add_moments(np.float32(j) - x0, y, r11, across, up2, e0, e1, exx, value, total, acc)
    for m in range(12):
        moments[m // 6, m % 6] = acc[m * _LANES : (m + 1) * _LANES].sum()
    for c in range(channels):
        grad_weight[c, n] += sums[c].sum()


@njit(inline="always")
def _pull_back(v, cone, planar, vec, inverse, matrix, white, moments, g, grad_point, grad_white):
    """Add dL/dposition and dL/dW of one view, from the moments of its footprint."""
    h, k = moments[0], moments[1]
    g[:] = 0.0  # gradients of w, WU, WV, nu, nv, e_centre
    hy, hxy, hyy = (0.0, 0.0, 0.0) if planar else (h[2], h[4], h[5])
    for a in range(3):
        g[3, a] = 2 * (vec[4, a] * h[3] + vec[5, a] * hxy)
        g[4, a] = 2 * (vec[4, a] * hxy + vec[5, a] * hyy)
        g[5, a] = 2 * vec[6, a] * k[0]
    g_column = -2 * (_dot(vec, 4, 4) * h[1] + _dot(vec, 4, 5) * hy)
    g_row = -2 * (_dot(vec, 4, 5) * h[1] + _dot(vec, 5, 5) * hy)
    if cone:
        ky, kxy, kyy = (0.0, 0.0, 0.0) if planar else (k[2], k[4], k[5])
        for a in range(3):
            g[5, a] += 2 * (vec[2, a] * k[1] + vec[3, a] * ky)
            g[1, a] = 2 * (vec[6, a] * k[1] + vec[2, a] * k[3] + vec[3, a] * kxy)
            g[2, a] = 2 * (vec[6, a] * ky + vec[2, a] * kxy + vec[3, a] * kyy)
        uu, uv, vv, eu, ev = (
            _dot(vec, 2, 2),
            _dot(vec, 2, 3),
            _dot(vec, 3, 3),
            _dot(vec, 6, 2),
            _dot(vec, 6, 3),
        )
        g_column -= 2 * (eu * k[0] + uu * k[1] + uv * ky)
        g_row -= 2 * (ev * k[0] + uv * k[1] + vv * ky)
    if planar:
        g_row = 0.0
    kappa = vec[7, 2]
    g_kappa = 0.0
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        # The adjoint of nu = w x WU (and of nv = w x WV alike).
        g[0, a] += vec[2, b] * g[3, c] - vec[2, c] * g[3, b] + vec[3, b] * g[4, c] - vec[3, c] * g[4, b]
        g[0, a] += kappa * g[5, a]
        g[1, a] += g[3, b] * vec[1, c] - g[3, c] * vec[1, b]
        g[2, a] += g[4, b] * vec[1, c] - g[4, c] * vec[1, b]
        g_kappa += g[5, a] * vec[1, a]
    for a in range(3):
        for b in range(3):
            grad_white[a, b] += g[0, a] * vec[0, b] + g[1, a] * matrix[v, b, 0] + g[2, a] * matrix[v, b, 1]
            if cone:
                grad_point[b] += white[a, b] * g[0, a]
    g_depth = -kappa * (g_column * vec[7, 0] + g_row * vec[7, 1] + g_kappa * kappa) if cone else 0.0
    for b in range(3):
        grad_point[b] += (
            kappa * (g_column * inverse[v, 0, b] + g_row * inverse[v, 1, b]) + g_depth * inverse[v, 2, b]
        )


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def _gather_range(
    start, stop, position, scale, rotation, weight, cone, planar, origin, inverse, matrix, cutoff, columns,
    record, span, grad_image, grad_position, grad_scale, grad_rotation, grad_weight,
):  # fmt: skip
    """The gradients of the Gaussians start..stop, summed over the views."""
    white, vec, moments, g = np.empty((3, 3)), np.empty((8, 3)), np.empty((2, 6)), np.empty((6, 3))
    grad_white, grad_point = np.empty((3, 3)), np.empty(3)
    value, total = np.empty(_LANES, np.float32), np.empty(_LANES, np.float32)
    sums, acc = np.empty((len(weight), _LANES), np.float32), np.empty(12 * _LANES, np.float32)
    for n in range(start, stop):
        whitening(scale, rotation, n, white)
        grad_white[:] = 0.0
        grad_point[:] = 0.0
        for v in range(len(origin)):
            if span[v, n, 0] < span[v, n, 1]:
                _gather(
                    v, n, record, span, weight, cutoff, columns, grad_image, value, total, sums, acc,
                    moments, grad_weight,
                )  # fmt: skip
                _chain(position, cone, origin, inverse, matrix, white, n, v, vec)
                _pull_back(v, cone, planar, vec, inverse, matrix, white, moments, g, grad_point, grad_white)
        for a in range(3):
            grad_position[n, a] = grad_point[a]
        whitening_adjoint(scale, rotation, n, white, grad_white, grad_scale, grad_rotation)


def forward(position, scale, rotation, weight, views: DetectorViews, cutoff: float):
    """Images (channels, views, rows, columns) float32 without the pixel factor, skipped pairs, and the state
    that :func:`backward` takes. Arguments as for the reference, as float32 numpy arrays."""
    count, channels = len(position), len(weight)
    record = np.empty((len(views), count, _RECORD), np.float32)
    span = np.empty((len(views), count, 2), np.int32)
    inverse = views.inverse
    scene = (position, scale, rotation, views.cone, views.planar, views.origin, inverse, views.matrix)
    parts = split_range(count, 4 * cpu_threads())
    skipped = sum(run_tasks(lambda a, b: _set_up(a, b, *scene, cutoff, views.rows, record, span), parts))
    image = np.zeros((len(views), views.rows, channels, views.columns + _LANES), np.float32)
    bands = split_range(views.rows, max(1, -(-2 * cpu_threads() // max(1, len(views)))))
    tasks = [(v, a, b) for v in range(len(views)) for a, b in bands]
    run_tasks(lambda v, a, b: _splat(v, a, b, record, span, weight, cutoff, views.columns, image), tasks)
    return image[..., : views.columns].transpose(2, 0, 1, 3), skipped, (record, span, inverse)


def backward(position, scale, rotation, weight, views: DetectorViews, cutoff: float, state, grad_image):
    """Gradients of position, scale, rotation and weight for ``grad_image`` (channels, views, rows, columns)."""
    record, span, inverse = state
    padded = np.zeros((len(views), views.rows, len(weight), views.columns + _LANES), np.float32)
    padded[..., : views.columns] = grad_image.transpose(1, 2, 0, 3)
    grads = tuple(np.zeros_like(a) for a in (position, scale, rotation, weight))
    scene = (position, scale, rotation, weight, views.cone, views.planar, views.origin, inverse, views.matrix)
    run_tasks(
        lambda a, b: _gather_range(a, b, *scene, cutoff, views.columns, record, span, padded, *grads),
        split_range(len(position), 16 * cpu_threads()),
    )
    return grads
