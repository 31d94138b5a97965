"""Gaussians sampled at voxel centres and the adjoint, compiled for the CPU. README.md derives the formulas.

The forward shares out slabs of slices and the backward Gaussians: no atomics, the same bits on every run.
"""

from __future__ import annotations

import math

import numpy as np

from tomo_polysplat.compiled import called, njit
from tomo_polysplat.kernels.gaussian_maths import FAST, gaussian, squared, whitening, whitening_adjoint
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
from tomo_polysplat.parallel import cpu_threads, run_tasks, shares

__all__ = ["backward", "forward"]

_NUMBERS = 15  # numbers of a Gaussian, in the order of _described
_MOMENTS = 9  # sums over the voxels of a Gaussian, in the order read by _pull_back


@njit(inline="always")
def _triangle(position, scale, rotation, n, first, spacing, white, q, rec):
    """Fill ``white`` = W, ``q`` with orthonormal columns and ``rec`` with the centre in voxels and r11, r12, r13,
    r22, r23, r33, so that W diag(spacing) = q r. The squared distance of the offset (x, y, z) in voxels is
    (r11 x + r12 y + r13 z)^2 + (r22 y + r23 z)^2 + (r33 z)^2."""
    whitening(scale, rotation, n, white)
    for k in range(3):
        rec[k] = (position[n, k] - first[k]) / spacing[k]
        for a in range(3):
            q[a, k] = white[a, k] * spacing[k]
    at = 3
    for k in range(3):
        norm2 = q[0, k] ** 2 + q[1, k] ** 2 + q[2, k] ** 2
        rec[at] = math.sqrt(norm2)
        inverse = 1.0 / rec[at] if norm2 > 0.0 else 0.0  # no extent along z in two dimensions
        for a in range(3):
            q[a, k] *= inverse
        for m in range(k + 1, 3):
            along = q[0, k] * q[0, m] + q[1, k] * q[1, m] + q[2, k] * q[2, m]
            rec[at + m - k] = along
            for a in range(3):
                q[a, m] -= along * q[a, k]
        at += 3 - k


@njit(inline="always")
def _interval(centre, shift, root, factor, length):
    """Half-open range of indices i with |factor (i - centre) + shift| <= root, within 0..length."""
    middle, spread = centre - shift / factor, root / factor
    low, high = max(0.0, np.ceil(middle - spread)), min(length - 1.0, np.floor(middle + spread))
    if not low <= high:
        return 0, 0
    return int(low), int(high) + 1


@njit(inline="always")
def _described(rec, cutoff, nz, nx, record, at):
    """Write the numbers of a Gaussian to ``record[at]``: those of `_triangle`; the slices that it reaches, a
    two-dimensional one (r33 = 0) all; the columns that it reaches in any row; 1 / r22 and r23 / r22."""
    r11, r12, r13, r22, r23, r33 = rec[3], rec[4], rec[5], rec[6], rec[7], rec[8]
    # The first row of the inverse of r: its length is the deviation along a row of voxels.
    second, third, low, high = r12 / r22, 0.0, 0, nz
    if r33 > 0.0:
        third = (second * r23 - r13) / r33
        low, high = _interval(rec[2], 0.0, cutoff, r33, nz)
    spread = cutoff * math.sqrt(1.0 + second * second + third * third)
    j0, j1 = _interval(rec[0], 0.0, spread, r11, nx)
    for k in range(9):
        record[at, k] = rec[k]
    record[at, 9], record[at, 10], record[at, 11], record[at, 12] = low, high, j0, j1
    record[at, 13], record[at, 14] = 1.0 / r22, r23 / r22


@njit(inline="always")
def _numbers_of(record, at):
    """The numbers of a Gaussian as tuples: an array would be read again after every store to another."""
    a = record[at]
    ranges = int(a[9]), int(a[10]), int(a[11]), int(a[12])
    return (a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8]), ranges, (a[13], a[14])


@njit(inline="always")
def _rows(rec, by, cut, ny, iz, rows):
    """Fill ``rows`` with the first row that a Gaussian reaches in each of ``LANES`` slices from ``iz`` on, and then with
    the one after its last: no more than the first where it reaches none."""
    (by_r22, slope), z0 = by, np.float32(iz) - rec[2]
    z = halves(z0, z0 + np.float32(HALF)) + ramp()
    left = cut - (rec[8] * z) * (rec[8] * z)
    spread, middle = by_r22 * left * inverse_root(left), rec[1] - slope * z
    store(rows, 0, ceiling(larger(middle - spread, np.float32(0))))
    store(rows, LANES, floor(smaller(middle + spread, np.float32(ny - 1))) + np.float32(1))


@njit(inline="always")
def _row_columns(rec, y, z, cut, length):
    """The columns a Gaussian reaches in one row."""
    w, u, across = rec[8] * z, rec[6] * y + rec[7] * z, rec[4] * y + rec[5] * z
    root = math.sqrt(max(np.float32(0), cut - w * w - u * u))
    return _interval(rec[0], across, root, rec[3], length)


@njit(nogil=True, cache=True, error_model="numpy")
def _set_up(start, stop, position, scale, rotation, first, spacing, cutoff, nz, nx, record):
    white, q, rec = np.empty((3, 3)), np.empty((3, 3)), np.empty(9)
    for n in range(start, stop):
        _triangle(position, scale, rotation, n, first, spacing, white, q, rec)
        _described(rec, cutoff, nz, nx, record, n)


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
def _gather(n, record, weight, cutoff, nx, grad_volume, rows, acc):
    """Write to ``acc``, lane by lane, the sums over the voxels of one Gaussian: of h times (t, u, w, tt, tu, tw, uu, uw,
    ww), with h = dL/d(distance^2) = dL/d(t^2 + u^2 + w^2), and of dL/df f by channel."""
    cut, half, one = squared(cutoff), np.float32(-0.5), np.float32(1)
    _, ny, channels, stride = grad_volume.shape
    rec, (low, high, j0, j1), by = _numbers_of(record, 0)
    xc, yc, zc, r11, r12, r13, r22, r23, r33 = rec
    narrow, wide = j1 - j0 <= HALF, j1 - j0 > LANES
    zero = halves(np.float32(0), np.float32(0))
    m0 = m1 = m2 = m3 = m4 = m5 = m6 = m7 = m8 = zero
    for c in range(channels):
        store(acc, (_MOMENTS + c) * LANES, zero)
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
                    to = (_MOMENTS + c) * LANES
                    store(acc, to, load(acc, to) + slope * value)
                h = half * total * value
                ht, hu, hw = h * t, h * u, h * w
                m0, m1, m2, m3, m4 = m0 + ht, m1 + hu, m2 + hw, m3 + ht * t, m4 + ht * u
                m5, m6, m7, m8 = m5 + ht * w, m6 + hu * u, m7 + hu * w, m8 + hw * w
            iy += 2 if two else 1
    to = 0
    for m in (m0, m1, m2, m3, m4, m5, m6, m7, m8):
        store(acc, to, m)
        to += LANES


# Inlined by LLVM, which compiles sooner than where Numba does it; the loop along a row would lose its vectors so.
@called(fastmath=FAST, error_model="numpy", forceinline=True)
def _pull_back(n, white, q, rec, spacing, m, grad_position, grad_white):
    """Write dL/dposition, and dL/dW to ``grad_white``, from the moments ``m`` of h with t = r (x, y, z)."""
    by_r33 = 1.0 / rec[8] if rec[8] > 0.0 else 0.0
    for b in range(3):
        grad_position[n, b] = 0.0
    for a in range(3):
        # distance^2 = |q t|^2 and dL/dr(x, y, z) = 2 q sum(h t t^T): solve with r, from z up.
        z = 2 * (q[a, 0] * m[5] + q[a, 1] * m[7] + q[a, 2] * m[8]) * by_r33
        y = (2 * (q[a, 0] * m[4] + q[a, 1] * m[6] + q[a, 2] * m[7]) - rec[7] * z) / rec[6]
        x = (2 * (q[a, 0] * m[3] + q[a, 1] * m[4] + q[a, 2] * m[5]) - rec[4] * y - rec[5] * z) / rec[3]
        grad_white[a, 0], grad_white[a, 1], grad_white[a, 2] = x * spacing[0], y * spacing[1], z * spacing[2]
        ahead = 2 * (q[a, 0] * m[0] + q[a, 1] * m[1] + q[a, 2] * m[2])
        for b in range(3):
            grad_position[n, b] -= ahead * white[a, b]


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def _gather_range(
    start, stop, position, scale, rotation, weight, first, spacing, cutoff, nx, grad_volume,
    grad_position, grad_scale, grad_rotation, grad_weight,
):  # fmt: skip
    """The gradients of the Gaussians start..stop."""
    white, q, rec, grad_white = np.empty((3, 3)), np.empty((3, 3)), np.empty(9), np.empty((3, 3))
    record, rows = np.empty((1, _NUMBERS), np.float32), np.empty(2 * LANES, np.float32)
    # As many sums as `lane_sums` makes at once.
    sums = np.empty(-(-(_MOMENTS + len(weight)) // LANES) * LANES, np.float32)
    acc = np.zeros(len(sums) * LANES, np.float32)
    for n in range(start, stop):
        _triangle(position, scale, rotation, n, first, spacing, white, q, rec)
        _described(rec, cutoff, len(grad_volume), nx, record, 0)
        _gather(n, record, weight, cutoff, nx, grad_volume, rows, acc)
        for some in range(0, len(sums), LANES):
            store(sums, some, lane_sums(acc, some * LANES))
        for c in range(len(weight)):
            grad_weight[c, n] = sums[_MOMENTS + c]
        _pull_back(n, white, q, rec, spacing, sums, grad_position, grad_white)
        whitening_adjoint(scale, rotation, n, white, grad_white, grad_scale, grad_rotation)


def forward(position, scale, rotation, weight, box: VoxelBox, cutoff: float) -> np.ndarray:
    """Volume (channels, nz, ny, nx) float32; arguments as for the reference, as float32 numpy arrays."""
    nz, ny, nx = box.shape
    record = np.empty((len(position), _NUMBERS), np.float32)
    scene = (position, scale, rotation, box.first, box.spacing, cutoff, nz, nx)
    run_tasks(lambda a, b: _set_up(a, b, *scene, record), shares(len(position), 4, cpu_threads()))
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
