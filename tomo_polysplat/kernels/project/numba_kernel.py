"""The projection of Gaussians and its adjoint, compiled for the CPU. README.md derives the formulas.

The forward shares out the images (each band of rows of each view is written by one thread) and the backward
the Gaussians, so neither needs atomics and both give the same bits on every run.
"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.compiled import njit
from tomo_polysplat.kernels.gaussian_maths import FAST, gaussian, squared
from tomo_polysplat.kernels.numba_group import (
    GROUP,
    SIZE,
    add_where,
    gaussian_of,
    in_threes,
    put_group,
    take_gradients,
    three,
)
from tomo_polysplat.kernels.numba_lanes import (
    FOLDED,
    HALF,
    LANES,
    add_blocks,
    fetch,
    halves,
    inverse_root,
    lane_sums,
    load,
    load_blocks,
    ramp,
    store,
    store_folded,
)
from tomo_polysplat.kernels.project.numba_footprint import (
    MOMENTS,
    RECORD,
    ends_of,
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
def _across(rec, j, two):
    """Of lanes on the columns from ``j`` on: u = r22 x, its square, and where y = 0 t, |e|^2 and its slope by y.

    They are the same in all rows. With ``two`` the columns of either half are the same.
    """
    x0 = np.float32(j) - rec[0]
    x = halves(x0, x0 + np.float32(0 if two else HALF)) + ramp()
    u = rec[4] * x
    return u, u * u, rec[3] * x, rec[5] + x * (rec[6] + x * rec[8]), rec[7] + rec[9] * x


@njit(inline="always")
def _down(rec, i, two):
    """y of lanes in the row ``i``, and with ``two`` in the next one."""
    y = np.float32(i) - rec[1]
    return halves(y, y + np.float32(1 if two else 0))


@njit(inline="always")
def _block(rec, across, y, cut, bottom):
    """t, 1 / |e|^2, the distance q and ``exp(-q / 2) / |e|``, zero beyond the cut and below the row ``bottom``."""
    t = across[2] + rec[2] * y
    root = inverse_root(across[3] + y * (across[4] + y * rec[10]))
    inverse = root * root
    q = (t * t + across[1]) * inverse
    return t, inverse, q, gaussian(q, cut, y, bottom, root)


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def _splat(v, first, last, record, span, weight, cutoff, image):
    """Add every footprint to the rows first..last of view ``v`` of ``image`` (views, rows, channels, padded).

    There are one channel, or three, or a multiple of three.
    """
    cut, zero = squared(cutoff), np.float32(0)
    rows, channels, stride = image.shape[1:]
    three = channels > 1
    for n in range(weight.shape[1]):
        numbers, k = record[v, n // GROUP], n % GROUP
        i0, i1, j0, j1 = ends_of(span[v, n // GROUP], k)
        low, high = max(first, i0), min(last, i1)
        if low >= high:
            continue
        rec = numbers_of(numbers, k)
        # Two short rows at once.
        two = j1 - j0 <= HALF
        each, bottom = 2 if two else 1, np.float32(high) - np.float32(0.5) - rec[1]
        for c in range(0, channels, 3):
            w0, w1, w2 = (
                weight[c, n],
                weight[c + 1, n] if three else zero,
                weight[c + 2, n] if three else zero,
            )
            for j in range(j0, j1, LANES):
                across, y = _across(rec, j, two), _down(rec, low, two)
                at = ((v * rows + low) * channels + c) * stride + j
                for i in range(low, high, each):
                    value = _block(rec, across, y, cut, bottom)[3]
                    apart = channels * stride if two and i + 1 < high else HALF
                    add_blocks(image, at, apart, w0, value)
                    if three:
                        add_blocks(image, at + stride, apart, w1, value)
                        add_blocks(image, at + 2 * stride, apart, w2, value)
                    y, at = y + np.float32(each), at + each * channels * stride


@njit(inline="always")
def _gather(v, n, k, numbers, ends, weight, cutoff, grad_image, acc):
    """Write to ``acc``, as those of Gaussian ``k`` of a group, the sums over the footprint of Gaussian ``n`` in view
    ``v``, folded: the moments in the order of ``pull_back``, then the gradient of its weight in every channel."""
    cut, half, none = squared(cutoff), np.float32(-0.5), np.float32(0)
    rows, channels, stride = grad_image.shape[1:]
    three = channels > 1
    rec, (low, high, j0, j1) = numbers_of(numbers, k), ends_of(ends, k)
    two = j1 - j0 <= HALF
    each, bottom = 2 if two else 1, np.float32(high) - np.float32(0.5) - rec[1]
    zero = halves(none, none)
    m0 = m1 = m2 = m3 = m4 = m5 = m6 = m7 = m8 = m9 = m10 = zero
    for c in range(0, channels, 3):
        w0, w1, w2 = weight[c, n], weight[c + 1, n] if three else none, weight[c + 2, n] if three else none
        s0 = s1 = s2 = zero
        for j in range(j0, j1, LANES):
            across, y = _across(rec, j, two), _down(rec, low, two)
            at = ((v * rows + low) * channels + c) * stride + j
            # u is the same in all rows, so sums of h and of g = h - s with 1, t and t^2 tell all moments.
            h0 = h1 = h2 = g0 = g1 = g2 = zero
            for i in range(low, high, each):
                t, inverse, q, value = _block(rec, across, y, cut, bottom)
                apart = channels * stride if two and i + 1 < high else HALF
                slope = load_blocks(grad_image, at, apart)
                total, s0 = w0 * slope, s0 + slope * value
                if three:
                    slope = load_blocks(grad_image, at + stride, apart)
                    total, s1 = total + w1 * slope, s1 + slope * value
                    slope = load_blocks(grad_image, at + 2 * stride, apart)
                    total, s2 = total + w2 * slope, s2 + slope * value
                h = half * total * value * inverse
                g = h * q
                ht, gt = h * t, g * t
                h0, h1, h2 = h0 + h, h1 + ht, h2 + ht * t
                g0, g1, g2 = g0 + g, g1 + gt, g2 + gt * t
                y, at = y + np.float32(each), at + each * channels * stride
            u, d0, d1 = across[0], h0 - g0, h1 - g1
            hu, du = u * h0, u * d0
            m0, m1, m2, m3, m4 = m0 + h1, m1 + hu, m2 + h2, m3 + u * h1, m4 + u * hu
            m5, m6, m7, m8, m9, m10 = m5 + d0, m6 + d1, m7 + du, m8 + (h2 - g2), m9 + u * d1, m10 + u * du
        _store_sums(acc, MOMENTS + c, k, (s0, s1, s2) if three else (s0, zero, zero), three)
    to, next_one = k * FOLDED, GROUP * FOLDED
    for m in (m0, m1, m2, m3, m4, m5, m6, m7, m8, m9, m10):
        store_folded(acc, to, m)
        to += next_one


@njit(inline="always")
def _store_sums(acc, first, k, sums, three):
    """Write the sums of one channel, or of three, to ``acc``."""
    to, each = (first * GROUP + k) * FOLDED, GROUP * FOLDED
    store_folded(acc, to, sums[0])
    if three:
        store_folded(acc, to + each, sums[1])
        store_folded(acc, to + 2 * each, sums[2])


@njit(inline="always")
def _gather_group(v, first, some, record, span, weight, cutoff, grad_image, acc, of_group, of_weight):
    """Fill ``of_group`` with the moments of a group in view ``v``, and with whether there is a footprint; add the
    gradients of the weights to ``of_weight``."""
    of_group[MOMENTS * GROUP :] = np.float32(0)
    g, last = first // GROUP, v + 1 == len(record)
    numbers, ends = record[v, g], span[v, g]
    # Of the next view, or of the next group: they lie far apart in memory.
    to, of = 0 if last else v + 1, min(g + 1, record.shape[1] - 1) if last else g
    fetch(record[to, of])
    fetch(span[to, of])
    for k in range(some):
        if ends[k] < ends[GROUP + k]:
            of_group[MOMENTS * GROUP + k] = np.float32(1)
        _gather(v, first + k, k, numbers, ends, weight, cutoff, grad_image, acc)
    for at in range(0, MOMENTS * GROUP, LANES):
        store(of_group, at, lane_sums(acc, at * FOLDED))
    for at in range(0, len(weight) * GROUP, LANES):
        sums = lane_sums(acc, (MOMENTS * GROUP + at) * FOLDED)
        store(of_weight, at, load(of_weight, at) + sums)


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
    start, stop, position, scale, rotation, weight, cone, planar, origin, inverse, matrix, cutoff,
    record, span, grad_image, grad_position, grad_scale, grad_rotation, grad_weight, grad_views,
):  # fmt: skip
    """The gradients of the Gaussians start..stop, summed over the views, and where there is room for them
    (groups, views, 12) those of the views, summed over each group: ``start`` begins one."""
    group, grads = np.zeros(SIZE * GROUP), np.empty(12 * GROUP)
    # The last number says whether there is a footprint.
    of_group = np.zeros((MOMENTS + 1) * GROUP, np.float32)
    of_weight = np.empty(len(weight) * GROUP, np.float32)
    acc = np.zeros((MOMENTS + len(weight)) * GROUP * FOLDED, np.float32)
    for first in range(start, stop, GROUP):
        some = min(GROUP, stop - first)
        put_group(first, some, position, scale, rotation, group)
        grads[:] = 0.0
        of_weight[:] = np.float32(0)
        for v in range(len(origin)):
            _gather_group(
                v, first, some, record, span, weight, cutoff, grad_image, acc, of_group, of_weight
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
    count, channels, weight = len(position), len(weight), in_threes(weight)
    groups = -(-count // GROUP)
    record = np.empty((len(views), groups, RECORD * GROUP), np.float32)
    span = np.empty((len(views), groups, 4 * GROUP), np.int32)
    inverse = views.inverse
    scene = (position, scale, rotation, views.cone, views.planar, views.origin, inverse, views.matrix)
    threads = cpu_threads()
    parts = shares(groups, 4, threads)
    skipped = sum(
        run_tasks(lambda a, b: set_up(a, b, *scene, cutoff, views.rows, views.columns, record, span), parts)
    )
    image = np.zeros((len(views), views.rows, len(weight), views.columns + LANES), np.float32)
    bands = split_range(views.rows, max(1, -(-2 * threads // max(1, len(views)))))
    tasks = [(v, a, b) for v in range(len(views)) for a, b in bands]
    run_tasks(lambda v, a, b: _splat(v, a, b, record, span, weight, cutoff, image), tasks)
    return image[..., :channels, : views.columns].transpose(2, 0, 1, 3), skipped, (record, span, inverse)


def backward(
    position, scale, rotation, weight, views: DetectorViews, cutoff: float, state, grad_image, of_views=False
):
    """Gradients of position, scale, rotation and weight for ``grad_image`` (channels, views, rows, columns).

    With ``of_views`` that of ``views.vectors`` comes fifth, (views, 4, 3) float64, without what the pixel factor adds.
    """
    record, span, inverse = state
    channels, weight = len(weight), in_threes(weight)
    padded = np.zeros((len(views), views.rows, len(weight), views.columns + LANES), np.float32)
    padded[..., :channels, : views.columns] = grad_image.transpose(1, 2, 0, 3)
    grads = tuple(np.zeros_like(a) for a in (position, scale, rotation, weight))
    groups = -(-len(position) // GROUP)
    # Sums of groups, so that the order of all additions is the same for any number of threads.
    by_group = np.zeros((groups if of_views else 0, len(views), 12))
    scene = (position, scale, rotation, weight, views.cone, views.planar, views.origin, inverse, views.matrix)
    rest = (*scene, cutoff, record, span, padded, *grads, by_group)
    run_tasks(
        lambda a, b: _gather_range(a * GROUP, min(b * GROUP, len(position)), *rest),
        shares(groups, 16, cpu_threads()),
    )
    grads = (*grads[:3], grads[3][:channels])
    return (*grads, by_group.sum(axis=0).reshape(-1, 4, 3)) if of_views else grads
