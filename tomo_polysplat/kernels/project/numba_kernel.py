"""The projection of Gaussians and its adjoint, compiled for the CPU. README.md derives the formulas.

The forward shares out the images (each band of rows of each view is written by one thread) and the backward
the Gaussians, so neither needs atomics and both give the same bits on every run.
"""

from __future__ import annotations

import math

import numpy as np

from tomo_polysplat.compiled import njit
from tomo_polysplat.kernels.gaussian_maths import FAST, gaussian, squared
from tomo_polysplat.kernels.numba_group import (
    GROUP,
    SIZE,
    add_where,
    gaussian_of,
    put_group,
    take_gradients,
    three,
)
from tomo_polysplat.kernels.numba_lanes import (
    HALF,
    LANES,
    add_blocks,
    halves,
    inverse_root,
    lane_sums,
    load,
    load_blocks,
    ramp,
    store,
)
from tomo_polysplat.kernels.project.numba_footprint import (
    MOMENTS,
    RECORD,
    numbers_of,
    pull_back,
    pull_back_view,
    ray_frame,
    rows_of,
    set_up,
)
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.parallel import cpu_threads, run_tasks, shares, split_range

__all__ = ["backward", "forward"]


@njit(inline="always")
def _columns(rec, y, cut, columns):
    """Half-open range of the columns inside the cut on the row ``y`` below the centre.

    Solved about the point where r11 x + r12 y = 0, so that nothing cancels however thin the Gaussian is.
    """
    one, two = np.float32(1), np.float32(2)
    up2 = (rec[4] * y) * (rec[4] * y)
    e0, e1 = rec[5] + y * (two * rec[7] + y * rec[10]), two * (rec[6] + rec[9] * y)
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
def _block(rec, x, y, cut):
    """t, u, 1 / |e|^2, the distance q and ``exp(-q / 2) / |e|``, zero beyond the cut, of lanes at the offset x, y."""
    two = np.float32(2)
    t, u = rec[2] * x + rec[3] * y, rec[4] * y
    e0, e1 = rec[5] + y * (two * rec[7] + y * rec[10]), two * rec[6] + two * rec[9] * y
    root = inverse_root(e0 + x * (e1 + x * rec[8]))
    inverse = root * root
    q = (t * t + u * u) * inverse
    return t, u, inverse, q, gaussian(q, cut, root)


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def _splat(v, first, last, record, span, weight, cutoff, columns, image):
    """Add every footprint to the rows first..last of view ``v`` of ``image`` (views, rows, channels, padded)."""
    cut = squared(cutoff)
    rows, channels, stride = image.shape[1:]
    for n in range(record.shape[1]):
        low, high = max(first, span[v, n, 0]), min(last, span[v, n, 1])
        rec = numbers_of(record, v, n)
        j0, j1 = span[v, n, 2], span[v, n, 3]
        narrow, wide = j1 - j0 <= HALF, j1 - j0 > LANES
        i = low
        while i < high:
            # Two short rows at once, where there are two.
            two = narrow and i + 1 < high
            y0 = np.float32(i) - rec[1]
            y = halves(y0, np.float32(i + 1) - rec[1] if two else y0)
            apart = channels * stride if two else HALF
            if wide:
                j0, j1 = _columns(rec, y0, cut, columns)
            for j in range(j0, j1, LANES):
                x0 = np.float32(j) - rec[0]
                x = halves(x0, x0 + np.float32(0 if two else HALF)) + ramp()
                value = _block(rec, x, y, cut)[4]
                at = ((v * rows + i) * channels) * stride + j
                for c in range(channels):
                    add_blocks(image, at + c * stride, apart, weight[c, n], value)
            i += 2 if two else 1


@njit(inline="always")
def _gather(v, n, k, record, span, weight, cutoff, columns, grad_image, acc):
    """Write to ``acc``, as those of Gaussian ``k`` of a group, the sums over the footprint of Gaussian ``n`` in view
    ``v``, lane by lane: the moments in the order of ``pull_back``, then the gradient of its weight in every channel."""
    cut, half, one = squared(cutoff), np.float32(-0.5), np.float32(1)
    rows, channels, stride = grad_image.shape[1:]
    rec = numbers_of(record, v, n)
    j0, j1 = span[v, n, 2], span[v, n, 3]
    narrow, wide = j1 - j0 <= HALF, j1 - j0 > LANES
    zero = halves(np.float32(0), np.float32(0))
    m0 = m1 = m2 = m3 = m4 = m5 = m6 = m7 = m8 = m9 = m10 = zero
    for c in range(channels):
        store(acc, ((MOMENTS + c) * GROUP + k) * LANES, zero)
    i, high = span[v, n, 0], span[v, n, 1]
    while i < high:
        two = narrow and i + 1 < high
        y0 = np.float32(i) - rec[1]
        y = halves(y0, np.float32(i + 1) - rec[1] if two else y0)
        apart = channels * stride if two else HALF
        if wide:
            j0, j1 = _columns(rec, y0, cut, columns)
        for j in range(j0, j1, LANES):
            x0 = np.float32(j) - rec[0]
            x = halves(x0, x0 + np.float32(0 if two else HALF)) + ramp()
            t, u, inverse, q, value = _block(rec, x, y, cut)
            at = ((v * rows + i) * channels) * stride + j
            total = zero
            for c in range(channels):
                slope = load_blocks(grad_image, at + c * stride, apart)
                total = total + weight[c, n] * slope
                to = ((MOMENTS + c) * GROUP + k) * LANES
                store(acc, to, load(acc, to) + slope * value)
            h = half * total * value * inverse
            s = h * (one - q)
            ht, hu, st, su = h * t, h * u, s * t, s * u
            m0, m1, m2, m3, m4 = m0 + ht, m1 + hu, m2 + ht * t, m3 + ht * u, m4 + hu * u
            m5, m6, m7, m8, m9, m10 = m5 + s, m6 + st, m7 + su, m8 + st * t, m9 + st * u, m10 + su * u
        i += 2 if two else 1
    to, each = k * LANES, GROUP * LANES
    for m in (m0, m1, m2, m3, m4, m5, m6, m7, m8, m9, m10):
        store(acc, to, m)
        to += each


@njit(inline="always")
def _gather_group(
    v, first, some, record, span, weight, cutoff, columns, grad_image, acc, of_group, of_weight
):
    """Fill ``of_group`` with the moments of a group in view ``v``, and with whether there is a footprint; add the
    gradients of the weights to ``of_weight``."""
    of_group[MOMENTS * GROUP :] = 0.0
    for k in range(some):
        if span[v, first + k, 0] < span[v, first + k, 1]:
            of_group[MOMENTS * GROUP + k] = 1.0
        _gather(v, first + k, k, record, span, weight, cutoff, columns, grad_image, acc)
    for m in range(MOMENTS):
        store(of_group, m * GROUP, lane_sums(acc, m * GROUP * LANES))
    for c in range(len(weight)):
        sums = lane_sums(acc, (MOMENTS + c) * GROUP * LANES)
        store(of_weight, c * GROUP, load(of_weight, c * GROUP) + sums)


@njit(inline="always")
def _moments_of(moments, k):
    return three(moments, 0, k), three(moments, 3, k), three(moments, 6, k), three(moments, 9, k)


@njit(inline="always")
def _take_back(cone, planar, origin, inverse, matrix, group, moments, grads):
    """Add dL/dposition (3) and dL/dW (9) of a view to those of a group."""
    for k in range(GROUP):
        position, _, white = gaussian_of(group, k)
        m = _moments_of(moments, k)
        frame = ray_frame(position, cone, origin, inverse, matrix, white)
        point, rows = pull_back(cone, planar, frame, inverse, matrix, white, m)
        # A Gaussian that is not seen may have no frame.
        add_where(m[3][2] > 0.0, grads, k, point, rows)


@njit(inline="always")
def _take_back_view(cone, planar, origin, inverse, matrix, group, moments, sums):
    """Fill ``sums`` (12) with dL/d(origin, U, V, D) of a view, summed over a group."""
    sums[:] = 0.0
    for k in range(GROUP):
        m = _moments_of(moments, k)
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
    group, grads = np.zeros(SIZE * GROUP), np.empty(12 * GROUP)
    # The last number says whether there is a footprint.
    of_group, of_weight = np.zeros((MOMENTS + 1) * GROUP), np.empty(len(weight) * GROUP, np.float32)
    acc = np.zeros((MOMENTS + len(weight)) * GROUP * LANES, np.float32)
    for first in range(start, stop, GROUP):
        some = min(GROUP, stop - first)
        put_group(first, some, position, scale, rotation, group)
        grads[:] = 0.0
        of_weight[:] = np.float32(0)
        for v in range(len(origin)):
            _gather_group(
                v, first, some, record, span, weight, cutoff, columns, grad_image, acc, of_group, of_weight
            )  # fmt: skip
            place = origin[v, 0], origin[v, 1], origin[v, 2]
            inverted, direct = rows_of(inverse[v]), rows_of(matrix[v])
            _take_back(cone, planar, place, inverted, direct, group, of_group, grads)
            if len(grad_views):
                of_view = grad_views[first // GROUP, v]
                _take_back_view(cone, planar, place, inverted, direct, group, of_group, of_view)
        take_gradients(first, some, group, grads, grad_position, grad_scale, grad_rotation)
        for k in range(some):
            for c in range(len(weight)):
                grad_weight[c, first + k] = of_weight[c * GROUP + k]


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
