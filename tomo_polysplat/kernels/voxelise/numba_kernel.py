"""Gaussians sampled at voxel centres and the adjoint, compiled for the CPU. README.md derives the formulas.

The forward shares out slabs of slices and the backward Gaussians: no atomics, the same bits on every run.
"""

from __future__ import annotations

import math

import numpy as np

from tomo_polysplat.compiled import njit
from tomo_polysplat.kernels.gaussian_maths import FAST, gaussian, squared
from tomo_polysplat.kernels.numba_group import GROUP, SIZE, put_group, take_gradients
from tomo_polysplat.kernels.numba_lanes import (
    HALF,
    LANES,
    add_blocks,
    ceiling,
    floor,
    halves,
    inverse_root,
    lane_sums,
    larger,
    load,
    load_blocks,
    ramp,
    smaller,
    store,
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
def _row_columns(rec, y, z, cut, length):
    """The columns a Gaussian reaches in one row."""
    w, u, across = rec[8] * z, rec[6] * y + rec[7] * z, rec[4] * y + rec[5] * z
    root = math.sqrt(max(np.float32(0), cut - w * w - u * u))
    middle, spread = rec[0] - across / rec[3], root / rec[3]
    low, high = max(0.0, np.ceil(middle - spread)), min(length - 1.0, np.floor(middle + spread))
    return (int(low), int(high) + 1) if low <= high else (0, 0)


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def _fill(first, last, record, weight, cutoff, ny, nx, volume):
    """Add every Gaussian to the slices first..last of ``volume`` (nz, ny, channels, padded nx)."""
    cut, one = squared(cutoff), np.float32(1)
    channels, stride = volume.shape[2:]
    rows = np.empty(2 * LANES, np.float32)
    for n in range(len(record)):
        rec, (low, high, j0, j1), by = _numbers_of(record, n)
        xc, yc, zc, r11, r12, r13, r22, r23, r33 = rec
        # A Gaussian of at most one block a row needs no range of columns for every row.
        narrow, wide = j1 - j0 <= HALF, j1 - j0 > LANES
        begin = max(low, first)
        for iz in range(begin, min(high, last)):
            at_slice = (iz - begin) % LANES
            if at_slice == 0:
                _rows(rec, by, cut, ny, iz, rows)
            z = np.float32(iz) - zc
            z2 = (r33 * z) * (r33 * z)
            iy, end = int(rows[at_slice]), int(rows[LANES + at_slice])
            while iy < end:
                # Two short rows at once, where there are two.
                two = narrow and iy + 1 < end
                y0 = np.float32(iy) - yc
                y = halves(y0, np.float32(iy + 1) - yc if two else y0)
                apart = channels * stride if two else HALF
                if wide:
                    j0, j1 = _row_columns(rec, y0, z, cut, nx)
                u = r22 * y + r23 * z
                rest, across = u * u + z2, r12 * y + r13 * z
                for j in range(j0, j1, LANES):
                    x0 = np.float32(j) - xc
                    x = halves(x0, x0 + np.float32(0 if two else HALF)) + ramp()
                    t = r11 * x + across
                    value = gaussian(t * t + rest, cut, one)
                    at = ((iz * ny + iy) * channels) * stride + j
                    for c in range(channels):
                        add_blocks(volume, at + c * stride, apart, weight[c, n], value)
                iy += 2 if two else 1


@njit(inline="always")
def _gather(n, k, record, weight, cutoff, nx, grad_volume, rows, acc):
    """Write to ``acc``, as those of Gaussian ``k`` of a group, the sums over the voxels of Gaussian ``n``, lane by
    lane: of h times (t, u, w, tt, tu, tw, uu, uw, ww), with h = dL/d(distance^2) = dL/d(t^2 + u^2 + w^2), and of
    dL/df f by channel."""
    cut, half, one = squared(cutoff), np.float32(-0.5), np.float32(1)
    _, ny, channels, stride = grad_volume.shape
    rec, (low, high, j0, j1), by = _numbers_of(record, k)
    xc, yc, zc, r11, r12, r13, r22, r23, r33 = rec
    narrow, wide = j1 - j0 <= HALF, j1 - j0 > LANES
    zero = halves(np.float32(0), np.float32(0))
    m0 = m1 = m2 = m3 = m4 = m5 = m6 = m7 = m8 = zero
    for c in range(channels):
        store(acc, ((MOMENTS + c) * GROUP + k) * LANES, zero)
    for iz in range(low, high):
        at_slice = (iz - low) % LANES
        if at_slice == 0:
            _rows(rec, by, cut, ny, iz, rows)
        z = np.float32(iz) - zc
        w = r33 * z
        z2 = w * w
        iy, end = int(rows[at_slice]), int(rows[LANES + at_slice])
        while iy < end:
            two = narrow and iy + 1 < end
            y0 = np.float32(iy) - yc
            y = halves(y0, np.float32(iy + 1) - yc if two else y0)
            apart = channels * stride if two else HALF
            if wide:
                j0, j1 = _row_columns(rec, y0, z, cut, nx)
            u = r22 * y + r23 * z
            rest, across = u * u + z2, r12 * y + r13 * z
            for j in range(j0, j1, LANES):
                x0 = np.float32(j) - xc
                x = halves(x0, x0 + np.float32(0 if two else HALF)) + ramp()
                t = r11 * x + across
                value = gaussian(t * t + rest, cut, one)
                at = ((iz * ny + iy) * channels) * stride + j
                total = zero
                for c in range(channels):
                    slope = load_blocks(grad_volume, at + c * stride, apart)
                    total = total + weight[c, n] * slope
                    to = ((MOMENTS + c) * GROUP + k) * LANES
                    store(acc, to, load(acc, to) + slope * value)
                h = half * total * value
                ht, hu, hw = h * t, h * u, h * w
                m0, m1, m2, m3, m4 = m0 + ht, m1 + hu, m2 + hw, m3 + ht * t, m4 + ht * u
                m5, m6, m7, m8 = m5 + ht * w, m6 + hu * u, m7 + hu * w, m8 + hw * w
            iy += 2 if two else 1
    to, each = k * LANES, GROUP * LANES
    for m in (m0, m1, m2, m3, m4, m5, m6, m7, m8):
        store(acc, to, m)
        to += each


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def _gather_range(
    start, stop, position, scale, rotation, weight, first, spacing, cutoff, nx, grad_volume,
    grad_position, grad_scale, grad_rotation, grad_weight,
):  # fmt: skip
    """The gradients of the Gaussians start..stop."""
    group, out, grads = np.zeros(SIZE * GROUP), np.empty(NUMBERS * GROUP), np.empty(12 * GROUP)
    record, rows = np.empty((GROUP, NUMBERS), np.float32), np.empty(2 * LANES, np.float32)
    moments = np.empty((MOMENTS + len(weight)) * GROUP)
    acc = np.zeros(len(moments) * QUARTER, np.float32)
    corner, edges = (first[0], first[1], first[2]), (spacing[0], spacing[1], spacing[2])
    for n in range(start, stop, GROUP):
        some = min(GROUP, stop - n)
        put_group(n, some, position, scale, rotation, group)
        describe(some, corner, edges, cutoff, len(grad_volume), nx, group, out, record, 0)
        for k in range(some):
            _gather(n + k, k, record, weight, cutoff, nx, grad_volume, rows, acc)
        for m in range(MOMENTS + len(weight)):
            store(moments, m * GROUP, lane_sums(acc, m * GROUP * QUARTER))
        pull_back(edges, group, moments, grads)
        take_gradients(n, some, group, grads, grad_position, grad_scale, grad_rotation)
        for c in range(len(weight)):
            for k in range(some):
                grad_weight[c, n + k] = moments[(MOMENTS + c) * GROUP + k]


def forward(position, scale, rotation, weight, box: VoxelBox, cutoff: float) -> np.ndarray:
    """Volume (channels, nz, ny, nx) float32; arguments as for the reference, as float32 numpy arrays."""
    nz, ny, nx = box.shape
    record = np.empty((len(position), NUMBERS), np.float32)
    scene = (position, scale, rotation, box.first, box.spacing, cutoff, nz, nx)
    run_tasks(lambda a, b: set_up(a, b, *scene, record), shares(len(position), 4, cpu_threads()))
    volume = np.zeros((nz, ny, len(weight), nx + LANES), np.float32)
    tasks = shares(nz, 2, cpu_threads())
    run_tasks(lambda a, b: _fill(a, b, record, weight, cutoff, ny, nx, volume), tasks)
    return volume[..., :nx].transpose(2, 0, 1, 3)


def backward(position, scale, rotation, weight, box: VoxelBox, cutoff: float, grad_volume: np.ndarray):
    """Gradients of position, scale, rotation and weight for ``grad_volume`` (channels, nz, ny, nx)."""
    nz, ny, nx = box.shape
    padded = np.zeros((nz, ny, len(weight), nx + LANES), np.float32)
    padded[..., :nx] = grad_volume.transpose(1, 2, 0, 3)
    grads = tuple(np.zeros_like(a) for a in (position, scale, rotation, weight))
    scene = (position, scale, rotation, weight, box.first, box.spacing, cutoff, nx, padded)
    run_tasks(lambda a, b: _gather_range(a, b, *scene, *grads), shares(len(position), 16, cpu_threads()))
    return grads
