"""The projection of Gaussians and its adjoint, compiled for the CPU. README.md derives the formulas.

The forward shares out the images (each band of rows of each view is written by one thread) and the backward
the Gaussians, so neither needs atomics and both give the same bits on every run.
"""

from __future__ import annotations

import math

import numpy as np

from tomo_polysplat.compiled import njit
from tomo_polysplat.kernels.gaussian_maths import FAST, gaussian, whitening_adjoint
from tomo_polysplat.kernels.numba_lanes import LANES, add_product, add_scaled, lane_sums
from tomo_polysplat.kernels.project.numba_footprint import (
    MOMENTS,
    RECORD,
    pull_back,
    pull_back_view,
    ray_frame,
    rows_of,
    set_up,
)
from tomo_polysplat.kernels.project.numba_group import (
    GROUP,
    SIZE,
    add_where,
    gaussian_of,
    moments_of,
    put_group,
)
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.parallel import cpu_threads, run_tasks, shares, split_range

__all__ = ["backward", "forward"]


@njit(inline="always")
def _row(rec, y):
    """What is constant on the row ``y`` below the centre: r12 y, (r22 y)^2, and |e|^2 as e0 + e1 x + rec[8] x^2."""
    two = np.float32(2)
    e0, e1 = rec[5] + y * (two * rec[7] + y * rec[10]), two * (rec[6] + rec[9] * y)
    return rec[3] * y, (rec[4] * y) * (rec[4] * y), e0, e1


@njit(inline="always")
def _columns(rec, y, up2, e0, e1, cut, columns):
    """Half-open range of the columns inside the cut on the row ``y`` below the centre.

    Solved about the point where r11 x + r12 y = 0, so that nothing cancels however thin the Gaussian is.
    """
    one = np.float32(1)
    shift = rec[11] * y
    square = rec[2] * rec[2] - cut * rec[8]
    half = cut * (np.float32(0.5) * e1 - shift * rec[8])
    inside = half * half - square * (up2 - cut * (e0 - shift * (e1 - shift * rec[8])))
    if not (inside > np.float32(0) and square > np.float32(0)):
        return 0, 0
    inverse = one / square
    spread, middle = math.sqrt(inside) * inverse, rec[0] - shift + half * inverse
    low, high = max(np.float32(0), np.ceil(middle - spread)), min(columns - one, np.floor(middle + spread))
    return (int(low), int(high) + 1) if low <= high else (0, 0)


@njit(inline="always")
def _inverse(x, e0, e1, e2):
    """1 / |e|^2; the bound is for pixels outside the cut, where rounding might make the sum negative."""
    length2 = e0 + x * (e1 + x * e2)
    return np.float32(1) / (length2 if length2 > np.float32(1e-20) else np.float32(1e-20))


@njit(inline="always")
def _block(x0, r11, across, up2, e0, e1, e2, cut, value):
    """``exp(-distance^2 / 2) / |e|`` of the pixels x0, x0 + 1, ... of one row, zero beyond the cut."""
    for k in range(LANES):
        x = np.float32(k) + x0
        t = r11 * x + across
        inverse = _inverse(x, e0, e1, e2)
        q = (t * t + up2) * inverse
        value[k] = gaussian(q, cut) * np.sqrt(inverse)


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def _splat(v, first, last, record, span, weight, cutoff, columns, image):
    """Add every footprint to the rows first..last of view ``v`` of ``image`` (views, rows, channels, padded)."""
    cut = np.float32(cutoff * cutoff)
    rows, channels, stride = image.shape[1:]
    value = np.empty(LANES, np.float32)
    for n in range(record.shape[1]):
        low, high = max(first, span[v, n, 0]), min(last, span[v, n, 1])
        if low >= high:
            continue
        rec = record[v, n]
        # Locals, not array reads, inside the row: only then does the compiler vectorise it.
        x0, r11, exx = rec[0], rec[2], rec[8]
        # A footprint of at most one block a row needs no range of columns for every row.
        j0, j1 = span[v, n, 2], span[v, n, 3]
        wide = j1 - j0 > LANES
        for i in range(low, high):
            y = np.float32(i) - rec[1]
            across, up2, e0, e1 = _row(rec, y)
            if wide:
                j0, j1 = _columns(rec, y, up2, e0, e1, cut, columns)
            for j in range(j0, j1, LANES):
                _block(np.float32(j) - x0, r11, across, up2, e0, e1, exx, cut, value)
                for c in range(channels):
                    add_scaled(image, ((v * rows + i) * channels + c) * stride + j, weight[c, n], value, 0)


@njit(inline="always")
def _add_moments(x0, r11, across, u, e0, e1, e2, value, total, acc):
    """Add the moments of one block, lane by lane and in the order of ``pull_back``, to ``acc``."""
    half, one = np.float32(0.5), np.float32(1)
    for k in range(LANES):
        x = np.float32(k) + x0
        t = r11 * x + across
        inverse = _inverse(x, e0, e1, e2)
        h = -half * total[k] * value[k] * inverse
        s = h * (one - (t * t + u * u) * inverse)
        acc[0 * LANES + k] += h * t
        acc[1 * LANES + k] += h * u
        acc[2 * LANES + k] += h * t * t
        acc[3 * LANES + k] += h * t * u
        acc[4 * LANES + k] += h * u * u
        acc[5 * LANES + k] += s
        acc[6 * LANES + k] += s * t
        acc[7 * LANES + k] += s * u
        acc[8 * LANES + k] += s * t * t
        acc[9 * LANES + k] += s * t * u
        acc[10 * LANES + k] += s * u * u


@njit(inline="always")
def _gather(
    v, n, record, span, weight, cutoff, columns, grad_image, value, total, acc, sums, grad_weight
):  # fmt: skip
    """Fill ``sums`` over the footprint of Gaussian ``n`` in view ``v``: the moments that ``pull_back`` takes, then the
    gradient of its weight in every channel, which is added to ``grad_weight``, too."""
    cut = np.float32(cutoff * cutoff)
    rec = record[v, n]
    x0, r11, exx = rec[0], rec[2], rec[8]
    rows, channels, stride = grad_image.shape[1:]
    acc[:] = np.float32(0)
    j0, j1 = span[v, n, 2], span[v, n, 3]
    wide = j1 - j0 > LANES
    for i in range(span[v, n, 0], span[v, n, 1]):
        y = np.float32(i) - rec[1]
        across, up2, e0, e1 = _row(rec, y)
        if wide:
            j0, j1 = _columns(rec, y, up2, e0, e1, cut, columns)
        for j in range(j0, j1, LANES):
            _block(np.float32(j) - x0, r11, across, up2, e0, e1, exx, cut, value)
            for k in range(LANES):
                total[k] = np.float32(0)
            for c in range(channels):
                at = ((v * rows + i) * channels + c) * stride + j
                add_product(acc, (MOMENTS + c) * LANES, grad_image, at, value, 0)
                add_scaled(total, 0, weight[c, n], grad_image, at)
            _add_moments(np.float32(j) - x0, r11, across, rec[4] * y, e0, e1, exx, value, total, acc)
    for some in range(0, len(sums), LANES):
        lane_sums(sums, some, acc, some * LANES)
    for c in range(channels):
        grad_weight[c, n] += sums[MOMENTS + c]


@njit(inline="always")
def _take_back(cone, planar, origin, inverse, matrix, group, moments, grads):
    """Add dL/dposition (3) and dL/dW (9) of a view to those of a group."""
    for k in range(GROUP):
        position, _, white = gaussian_of(group, k)
        m = moments_of(moments, k)
        frame = ray_frame(position, cone, origin, inverse, matrix, white)
        point, rows = pull_back(cone, planar, frame, inverse, matrix, white, m)
        # A Gaussian that is not seen may have no frame.
        add_where(m[3][2] > 0.0, grads, k, point, rows)


@njit(inline="always")
def _take_back_view(cone, planar, origin, inverse, matrix, group, moments, sums):
    """Fill ``sums`` (12) with dL/d(origin, U, V, D) of a view, summed over a group."""
    sums[:] = 0.0
    for k in range(GROUP):
        m = moments_of(moments, k)
        if m[3][2] > 0.0:
            point, _, white = gaussian_of(group, k)
            frame = ray_frame(point, cone, origin, inverse, matrix, white)
            parts = pull_back_view(cone, planar, point, frame, origin, inverse, white, m)
            for a in range(3):
                sums[a] += parts[0][a]
                sums[3 + a] += parts[1][a]
                sums[6 + a] += parts[2][a]
                sums[9 + a] += parts[3][a]


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def _gather_range(
    start, stop, position, scale, rotation, weight, cone, planar, origin, inverse, matrix, cutoff, columns,
    record, span, grad_image, grad_position, grad_scale, grad_rotation, grad_weight, grad_views,
):  # fmt: skip
    """The gradients of the Gaussians start..stop, summed over the views, and where there is room for them
    (groups, views, 12) those of the views, summed over each group: ``start`` begins one."""
    white, grad_white = np.empty((3, 3)), np.empty((3, 3))
    value, total = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    # As many sums as `lane_sums` makes at once.
    sums = np.empty(-(-(MOMENTS + len(weight)) // LANES) * LANES, np.float32)
    acc = np.empty(len(sums) * LANES, np.float32)
    group, grads = np.zeros(SIZE * GROUP), np.empty(12 * GROUP)
    # The last number says whether there is a footprint.
    of_group = np.empty((MOMENTS + 1) * GROUP)
    for first in range(start, stop, GROUP):
        some = min(GROUP, stop - first)
        put_group(first, some, position, scale, rotation, white, group)
        grads[:] = 0.0
        for v in range(len(origin)):
            of_group[:] = 0.0
            for k in range(some):
                n = first + k
                if span[v, n, 0] < span[v, n, 1]:
                    _gather(
                        v, n, record, span, weight, cutoff, columns, grad_image, value, total, acc, sums,
                        grad_weight,
                    )  # fmt: skip
                    for m in range(MOMENTS):
                        of_group[m * GROUP + k] = sums[m]
                    of_group[MOMENTS * GROUP + k] = 1.0
            place = origin[v, 0], origin[v, 1], origin[v, 2]
            inverted, direct = rows_of(inverse[v]), rows_of(matrix[v])
            _take_back(cone, planar, place, inverted, direct, group, of_group, grads)
            if len(grad_views):
                of_view = grad_views[first // GROUP, v]
                _take_back_view(cone, planar, place, inverted, direct, group, of_group, of_view)
        for k in range(some):
            n = first + k
            for a in range(3):
                grad_position[n, a] = grads[a * GROUP + k]
                for b in range(3):
                    white[a, b] = group[(6 + 3 * a + b) * GROUP + k]
                    grad_white[a, b] = grads[(3 + 3 * a + b) * GROUP + k]
            whitening_adjoint(scale, rotation, n, white, grad_white, grad_scale, grad_rotation)


def forward(position, scale, rotation, weight, views: DetectorViews, cutoff: float):
    """Images (channels, views, rows, columns) float32 without the pixel factor, skipped pairs, and the state
    that :func:`backward` takes. Arguments as for the reference, as float32 numpy arrays."""
    count, channels = len(position), len(weight)
    record = np.empty((len(views), count, RECORD), np.float32)
    span = np.empty((len(views), count, 4), np.int32)
    inverse = views.inverse
    scene = (position, scale, rotation, views.cone, views.planar, views.origin, inverse, views.matrix)
    parts = shares(count, 4, cpu_threads())
    skipped = sum(
        run_tasks(lambda a, b: set_up(a, b, *scene, cutoff, views.rows, views.columns, record, span), parts)
    )
    image = np.zeros((len(views), views.rows, channels, views.columns + LANES), np.float32)
    bands = split_range(views.rows, max(1, -(-2 * cpu_threads() // max(1, len(views)))))
    tasks = [(v, a, b) for v in range(len(views)) for a, b in bands]
    run_tasks(lambda v, a, b: _splat(v, a, b, record, span, weight, cutoff, views.columns, image), tasks)
    return image[..., : views.columns].transpose(2, 0, 1, 3), skipped, (record, span, inverse)


def backward(
    position, scale, rotation, weight, views: DetectorViews, cutoff: float, state, grad_image, of_views=False
):
    """Gradients of position, scale, rotation and weight for ``grad_image`` (channels, views, rows, columns).

    With ``of_views`` that of ``views.vectors`` comes fifth, (views, 4, 3) float64, without what the pixel factor adds.
    """
    record, span, inverse = state
    padded = np.zeros((len(views), views.rows, len(weight), views.columns + LANES), np.float32)
    padded[..., : views.columns] = grad_image.transpose(1, 2, 0, 3)
    grads = tuple(np.zeros_like(a) for a in (position, scale, rotation, weight))
    groups = -(-len(position) // GROUP)
    # Sums of groups, so that the order of all additions is the same for any number of threads.
    by_group = np.zeros((groups if of_views else 0, len(views), 12))
    scene = (position, scale, rotation, weight, views.cone, views.planar, views.origin, inverse, views.matrix)
    rest = (*scene, cutoff, views.columns, record, span, padded, *grads, by_group)
    run_tasks(
        lambda a, b: _gather_range(a * GROUP, min(b * GROUP, len(position)), *rest),
        shares(groups, 16, cpu_threads()),
    )
    return (*grads, by_group.sum(axis=0).reshape(-1, 4, 3)) if of_views else grads
