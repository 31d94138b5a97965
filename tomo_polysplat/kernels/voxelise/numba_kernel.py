"""Gaussians sampled at voxel centres and the adjoint, compiled for the CPU. README.md derives the formulas.

The forward shares out slabs of slices and the backward Gaussians: no atomics, the same bits on every run.
"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.compiled import njit
from tomo_polysplat.kernels.gaussian_maths import FAST, gaussian, squared
from tomo_polysplat.kernels.numba_group import GROUP, SIZE, in_threes, put_group, take_gradients
from tomo_polysplat.kernels.numba_lanes import (
    FOLDED,
    HALF,
    LANES,
    add_blocks,
    ceiling,
    floor,
    halves,
    inverse_root,
    lane_sums,
    larger,
    load_blocks,
    ramp,
    smaller,
    store,
    store_folded,
)
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.kernels.voxelise.numba_ellipsoid import MOMENTS, NUMBERS, describe, pull_back, set_up
from tomo_polysplat.parallel import cpu_threads, run_tasks, shares

__all__ = ["backward", "forward"]


@njit(inline="always")
def _numbers_of(record, at):
    """The numbers of a Gaussian as tuples: an array would be read again after every store to another."""
    a = record[at]
    ranges = int(a[9]), int(a[10]), int(a[11]), int(a[12])
    return (a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8]), ranges, (a[13], a[14])


@njit(inline="always")
def _rows(rec, by, cut, ny, iz, rows):
    """Fill ``rows`` with the first row that a Gaussian reaches in each of ``LANES`` slices from ``iz`` on, and then
    with the one after its last: no more than the first where it reaches none."""
    by_r22, slope = by
    # Rounded once, so that a slice has the same rows wherever a thread begins.
    z = halves(np.float32(iz), np.float32(iz + HALF)) + ramp() - rec[2]
    left = cut - (rec[8] * z) * (rec[8] * z)
    spread, middle = by_r22 * left * inverse_root(left), rec[1] - slope * z
    store(rows, 0, ceiling(larger(middle - spread, np.float32(0))))
    store(rows, LANES, floor(smaller(middle + spread, np.float32(ny - 1))) + np.float32(1))


@njit(inline="always")
def _across(rec, j, two):
    """r11 x of lanes on the columns from ``j`` on; with ``two`` those of either half are the same."""
    x0 = np.float32(j) - rec[0]
    return rec[3] * (halves(x0, x0 + np.float32(0 if two else HALF)) + ramp())


@njit(inline="always")
def _slice(rec, across, iz, iy, two):
    """t and u where y = 0, w, and y of lanes in the row ``iy``, and with ``two`` in the next one, of a slice."""
    z, y = np.float32(iz) - rec[2], np.float32(iy) - rec[1]
    return (across + rec[5] * z, rec[7] * z, rec[8] * z), halves(y, y + np.float32(1 if two else 0))


@njit(inline="always")
def _block(rec, begun, y, cut, bottom):
    """t, u and the value of lanes, zero beyond the cut and below the row ``bottom``."""
    t, u = begun[0] + rec[4] * y, begun[1] + rec[6] * y
    return t, u, gaussian(t * t + (u * u + begun[2] * begun[2]), cut, y, bottom, np.float32(1))


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def _fill(first, last, record, weight, cutoff, ny, volume):
    """Add every Gaussian to the slices first..last of ``volume`` (nz, ny, channels, padded nx).

    There are one channel, or three, or a multiple of three.
    """
    cut, none = squared(cutoff), np.float32(0)
    channels, stride = volume.shape[2:]
    three, rows = channels > 1, np.empty(2 * LANES, np.float32)
    for n in range(len(record)):
        rec, (low, high, j0, j1), by = _numbers_of(record, n)
        begin, end = max(low, first), min(high, last)
        # Two short rows at once.
        two = j1 - j0 <= HALF
        each = 2 if two else 1
        for c in range(0, channels, 3):
            w0, w1, w2 = (
                weight[c, n],
                weight[c + 1, n] if three else none,
                weight[c + 2, n] if three else none,
            )
            for j in range(j0, j1, LANES):
                across = _across(rec, j, two)
                for iz in range(begin, end):
                    place = (iz - begin) % LANES
                    if place == 0:
                        _rows(rec, by, cut, ny, iz, rows)
                    i0, i1 = int(rows[place]), int(rows[LANES + place])
                    begun, y = _slice(rec, across, iz, i0, two)
                    bottom = np.float32(i1) - np.float32(0.5) - rec[1]
                    at = ((iz * ny + i0) * channels + c) * stride + j
                    for iy in range(i0, i1, each):
                        value = _block(rec, begun, y, cut, bottom)[2]
                        apart = channels * stride if two and iy + 1 < i1 else HALF
                        add_blocks(volume, at, apart, w0, value)
                        if three:
                            add_blocks(volume, at + stride, apart, w1, value)
                            add_blocks(volume, at + 2 * stride, apart, w2, value)
                        y, at = y + np.float32(each), at + each * channels * stride


@njit(inline="always")
def _gather(n, k, record, weight, cutoff, grad_volume, rows, acc):
    """Write to ``acc``, as those of Gaussian ``k`` of a group, the sums over the voxels of Gaussian ``n``, folded:
    of h times (t, u, w, tt, tu, tw, uu, uw, ww), with h = dL/d(distance^2) = dL/d(t^2 + u^2 + w^2), and of
    dL/df f by channel."""
    cut, half, none = squared(cutoff), np.float32(-0.5), np.float32(0)
    _, ny, channels, stride = grad_volume.shape
    rec, (low, high, j0, j1), by = _numbers_of(record, k)
    three, two = channels > 1, j1 - j0 <= HALF
    each, zero = 2 if two else 1, halves(none, none)
    m0 = m1 = m2 = m3 = m4 = m5 = m6 = m7 = m8 = zero
    for c in range(0, channels, 3):
        w0, w1, w2 = weight[c, n], weight[c + 1, n] if three else none, weight[c + 2, n] if three else none
        s0 = s1 = s2 = zero
        for j in range(j0, j1, LANES):
            across = _across(rec, j, two)
            for iz in range(low, high):
                place = (iz - low) % LANES
                if place == 0:
                    _rows(rec, by, cut, ny, iz, rows)
                i0, i1 = int(rows[place]), int(rows[LANES + place])
                begun, y = _slice(rec, across, iz, i0, two)
                bottom = np.float32(i1) - np.float32(0.5) - rec[1]
                at = ((iz * ny + i0) * channels + c) * stride + j
                # w is the same in a slice: of h, h t and h u there is a sum by slices.
                by_h = by_t = by_u = zero
                for iy in range(i0, i1, each):
                    t, u, value = _block(rec, begun, y, cut, bottom)
                    apart = channels * stride if two and iy + 1 < i1 else HALF
                    slope = load_blocks(grad_volume, at, apart)
                    total, s0 = w0 * slope, s0 + slope * value
                    if three:
                        slope = load_blocks(grad_volume, at + stride, apart)
                        total, s1 = total + w1 * slope, s1 + slope * value
                        slope = load_blocks(grad_volume, at + 2 * stride, apart)
                        total, s2 = total + w2 * slope, s2 + slope * value
                    h = half * total * value
                    ht, hu = h * t, h * u
                    by_h, by_t, by_u = by_h + h, by_t + ht, by_u + hu
                    m3, m4, m6 = m3 + ht * t, m4 + ht * u, m6 + hu * u
                    y, at = y + np.float32(each), at + each * channels * stride
                w = begun[2]
                hw = w * by_h
                m0, m1, m2, m5, m7, m8 = (
                    m0 + by_t,
                    m1 + by_u,
                    m2 + hw,
                    m5 + w * by_t,
                    m7 + w * by_u,
                    m8 + w * hw,
                )
        to = ((MOMENTS + c) * GROUP + k) * FOLDED
        store_folded(acc, to, s0)
        if three:
            store_folded(acc, to + GROUP * FOLDED, s1)
            store_folded(acc, to + 2 * GROUP * FOLDED, s2)
    to = k * FOLDED
    for m in (m0, m1, m2, m3, m4, m5, m6, m7, m8):
        store_folded(acc, to, m)
        to += GROUP * FOLDED


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def _gather_range(
    start, stop, position, scale, rotation, weight, first, spacing, cutoff, nx, grad_volume,
    grad_position, grad_scale, grad_rotation, grad_weight,
):  # fmt: skip
    """The gradients of the Gaussians start..stop."""
    group, out, grads = np.zeros(SIZE * GROUP), np.empty(NUMBERS * GROUP), np.empty(12 * GROUP)
    record, rows = np.empty((GROUP, NUMBERS), np.float32), np.empty(2 * LANES, np.float32)
    moments = np.empty((MOMENTS + len(weight)) * GROUP)
    acc = np.zeros(len(moments) * FOLDED, np.float32)
    corner, edges = (first[0], first[1], first[2]), (spacing[0], spacing[1], spacing[2])
    for n in range(start, stop, GROUP):
        some = min(GROUP, stop - n)
        put_group(n, some, position, scale, rotation, group)
        describe(some, corner, edges, cutoff, len(grad_volume), nx, group, out, record, 0)
        for k in range(some):
            _gather(n + k, k, record, weight, cutoff, grad_volume, rows, acc)
        for at in range(0, len(moments), LANES):
            store(moments, at, lane_sums(acc, at * FOLDED))
        pull_back(edges, group, moments, grads)
        take_gradients(n, some, group, grads, grad_position, grad_scale, grad_rotation)
        for c in range(len(weight)):
            for k in range(some):
                grad_weight[c, n + k] = moments[(MOMENTS + c) * GROUP + k]


def forward(position, scale, rotation, weight, box: VoxelBox, cutoff: float) -> np.ndarray:
    """Volume (channels, nz, ny, nx) float32; arguments as for the reference, as float32 numpy arrays."""
    (nz, ny, nx), channels, weight = box.shape, len(weight), in_threes(weight)
    record = np.empty((len(position), NUMBERS), np.float32)
    scene = (position, scale, rotation, box.first, box.spacing, cutoff, nz, nx)
    threads = cpu_threads()
    run_tasks(lambda a, b: set_up(a, b, *scene, record), shares(len(position), 4, threads))
    volume = np.zeros((nz, ny, len(weight), nx + LANES), np.float32)
    tasks = shares(nz, 2, threads)
    run_tasks(lambda a, b: _fill(a, b, record, weight, cutoff, ny, volume), tasks)
    return volume[..., :channels, :nx].transpose(2, 0, 1, 3)


def backward(position, scale, rotation, weight, box: VoxelBox, cutoff: float, grad_volume: np.ndarray):
    """Gradients of position, scale, rotation and weight for ``grad_volume`` (channels, nz, ny, nx)."""
    (nz, ny, nx), channels, weight = box.shape, len(weight), in_threes(weight)
    padded = np.zeros((nz, ny, len(weight), nx + LANES), np.float32)
    padded[..., :channels, :nx] = grad_volume.transpose(1, 2, 0, 3)
    grads = tuple(np.zeros_like(a) for a in (position, scale, rotation, weight))
    scene = (position, scale, rotation, weight, box.first, box.spacing, cutoff, nx, padded)
    run_tasks(lambda a, b: _gather_range(a, b, *scene, *grads), shares(len(position), 16, cpu_threads()))
    return (*grads[:3], grads[3][:channels])
