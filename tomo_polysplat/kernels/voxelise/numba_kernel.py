"""Gaussians sampled at voxel centres and the adjoint, compiled for the CPU. README.md derives the formulas.

The forward shares out slabs of slices and the backward Gaussians: no atomics, the same bits on every run.
"""

from __future__ import annotations

import math

import numpy as np

from tomo_polysplat.compiled import called, njit
from tomo_polysplat.kernels.gaussian_maths import FAST, gaussian, whitening, whitening_adjoint
from tomo_polysplat.kernels.numba_lanes import LANES, add_product, add_scaled, lane_sums
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.parallel import cpu_threads, run_tasks, shares

__all__ = ["backward", "forward"]

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
def _slices(rec, cutoff, length):
    """The slices a Gaussian reaches; a two-dimensional one (r33 = 0) reaches all."""
    if rec[8] == 0.0:
        return 0, length
    return _interval(rec[2], 0.0, cutoff, rec[8], length)


@njit(inline="always")
def _columns(rec, cutoff, length):
    """The columns a Gaussian reaches in any row, and whether they are more than one block."""
    r11, r12, r13, r22, r23, r33 = rec[3:]
    # The first row of the inverse of r: its length is the deviation along a row of voxels.
    by_r11, by_r22 = np.float32(1) / r11, np.float32(1) / r22
    second, third = r12 * by_r22, np.float32(0)
    if r33 > np.float32(0):
        third = (second * r23 - r13) / r33
    spread = cutoff * by_r11 * math.sqrt(np.float32(1) + second * second + third * third)
    j0, j1 = _interval(rec[0], np.float32(0), spread, np.float32(1), length)
    return j0, j1, j1 - j0 > LANES


@njit(nogil=True, cache=True, error_model="numpy")
def _set_up(start, stop, position, scale, rotation, first, spacing, record):
    white, q, rec = np.empty((3, 3)), np.empty((3, 3)), np.empty(9)
    for n in range(start, stop):
        _triangle(position, scale, rotation, n, first, spacing, white, q, rec)
        for k in range(9):
            record[n, k] = rec[k]


@njit(inline="always")
def _block(x0, r11, across, rest, cut, value):
    """``exp(-distance^2 / 2)`` of the voxels x0, x0 + 1, ... of one row, zero beyond the cut."""
    for k in range(LANES):
        t = r11 * (np.float32(k) + x0) + across
        value[k] = gaussian(t * t + rest, cut)


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def _fill(first, last, record, weight, cutoff, ny, nx, volume):
    """Add every Gaussian to the slices first..last of ``volume`` (nz, ny, channels, padded nx)."""
    cut = np.float32(cutoff * cutoff)
    value = np.empty(LANES, np.float32)
    nz, _, channels, stride = volume.shape
    for n in range(len(record)):
        rec = record[n]
        xc, yc, zc, r11, r12, r13, r22, r23, r33 = rec
        low, high = _slices(rec, cutoff, nz)
        # A Gaussian of at most one block a row needs no range of columns for every row.
        j0, j1, wide = _columns(rec, cutoff, nx)
        for iz in range(max(low, first), min(high, last)):
            z = np.float32(iz) - zc
            z2 = (r33 * z) * (r33 * z)
            y0, y1 = _interval(yc, r23 * z, math.sqrt(max(np.float32(0), cut - z2)), r22, ny)
            for iy in range(y0, y1):
                y = np.float32(iy) - yc
                up = r22 * y + r23 * z
                rest, across = z2 + up * up, r12 * y + r13 * z
                if wide:
                    j0, j1 = _interval(xc, across, math.sqrt(max(np.float32(0), cut - rest)), r11, nx)
                for j in range(j0, j1, LANES):
                    _block(np.float32(j) - xc, r11, across, rest, cut, value)
                    for c in range(channels):
                        at = ((iz * ny + iy) * channels + c) * stride + j
                        add_scaled(volume, at, weight[c, n], value, 0)


@njit(inline="always")
def _gather(n, rec, weight, cutoff, nx, grad_volume, value, total, acc):
    """Lane sums over the voxels of one Gaussian: of h times (t, u, w, tt, tu, tw, uu, uw, ww), with
    h = dL/d(distance^2) = dL/d(t^2 + u^2 + w^2), and of dL/df f by channel."""
    cut = np.float32(cutoff * cutoff)
    half = np.float32(-0.5)
    xc, yc, zc, r11, r12, r13, r22, r23, r33 = rec
    nz, ny, channels, stride = grad_volume.shape
    low, high = _slices(rec, cutoff, nz)
    j0, j1, wide = _columns(rec, cutoff, nx)
    for iz in range(low, high):
        z = np.float32(iz) - zc
        deep = r33 * z
        z2 = deep * deep
        y0, y1 = _interval(yc, r23 * z, math.sqrt(max(np.float32(0), cut - z2)), r22, ny)
        for iy in range(y0, y1):
            y = np.float32(iy) - yc
            up = r22 * y + r23 * z
            rest, across = z2 + up * up, r12 * y + r13 * z
            if wide:
                j0, j1 = _interval(xc, across, math.sqrt(max(np.float32(0), cut - rest)), r11, nx)
            for j in range(j0, j1, LANES):
                x0 = np.float32(j) - xc
                _block(x0, r11, across, rest, cut, value)
                for k in range(LANES):
                    total[k] = np.float32(0)
                for c in range(channels):
                    at = ((iz * ny + iy) * channels + c) * stride + j
                    add_product(acc, (_MOMENTS + c) * LANES, grad_volume, at, value, 0)
                    add_scaled(total, 0, weight[c, n], grad_volume, at)
                for k in range(LANES):
                    t = r11 * (np.float32(k) + x0) + across
                    h = half * total[k] * value[k]
                    acc[0 * LANES + k] += h * t
                    acc[1 * LANES + k] += h * up
                    acc[2 * LANES + k] += h * deep
                    acc[3 * LANES + k] += h * t * t
                    acc[4 * LANES + k] += h * t * up
                    acc[5 * LANES + k] += h * t * deep
                    acc[6 * LANES + k] += h * up * up
                    acc[7 * LANES + k] += h * up * deep
                    acc[8 * LANES + k] += h * deep * deep


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
    single = np.empty(9, np.float32)
    value, total = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    # As many sums as `lane_sums` makes at once.
    sums = np.empty(-(-(_MOMENTS + len(weight)) // LANES) * LANES, np.float32)
    acc = np.empty(len(sums) * LANES, np.float32)
    for n in range(start, stop):
        _triangle(position, scale, rotation, n, first, spacing, white, q, rec)
        for k in range(9):
            single[k] = rec[k]
        acc[:] = np.float32(0)
        _gather(n, single, weight, cutoff, nx, grad_volume, value, total, acc)
        for some in range(0, len(sums), LANES):
            lane_sums(sums, some, acc, some * LANES)
        for c in range(len(weight)):
            grad_weight[c, n] = sums[_MOMENTS + c]
        _pull_back(n, white, q, rec, spacing, sums, grad_position, grad_white)
        whitening_adjoint(scale, rotation, n, white, grad_white, grad_scale, grad_rotation)


def forward(position, scale, rotation, weight, box: VoxelBox, cutoff: float) -> np.ndarray:
    """Volume (channels, nz, ny, nx) float32; arguments as for the reference, as float32 numpy arrays."""
    nz, ny, nx = box.shape
    record = np.empty((len(position), 9), np.float32)
    scene = (position, scale, rotation, box.first, box.spacing)
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
