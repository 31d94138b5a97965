"""Gaussians sampled at voxel centres and the adjoint, compiled for the CPU. README.md derives the formulas.

The forward shares out slabs of slices and the backward Gaussians: no atomics, the same bits on every run.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tomo_polysplat.kernels.gaussian_maths import FAST, exp_negative, whitening, whitening_adjoint
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.parallel import cpu_threads, run_tasks, split_range

__all__ = ["backward", "forward"]

_LANES = 16  # voxels of a row handled together; volumes are padded so that a block may run past the row's end


@njit(inline="always")
def _scaled(position, scale, rotation, n, first, spacing, white, scaled, rec):
    """Fill ``scaled`` = W diag(spacing) and ``rec``: the centre in voxels and the triangle r of its QR
    factors, so that the squared distance is (r11 x + r12 y + r13 z)^2 + (r22 y + r23 z)^2 + (r33 z)^2."""
    whitening(scale, rotation, n, white)
    for k in range(3):
        rec[k] = (position[n, k] - first[k]) / spacing[k]
        for a in range(3):
            scaled[a, k] = white[a, k] * spacing[k]
    xx = yy = zz = xy = xz = yz = 0.0
    for a in range(3):
        xx += scaled[a, 0] * scaled[a, 0]
        xy += scaled[a, 0] * scaled[a, 1]
        xz += scaled[a, 0] * scaled[a, 2]
    rec[3] = math.sqrt(xx)
    rec[4], rec[5] = xy / rec[3], xz / rec[3]
    # What is left of y and z across x, as vectors: squares subtracted afterwards would cancel.
    for a in range(3):
        y = scaled[a, 1] - scaled[a, 0] * xy / xx
        z = scaled[a, 2] - scaled[a, 0] * xz / xx
        yy += y * y
        yz += y * z
    rec[6] = math.sqrt(yy)
    rec[7] = yz / rec[6]
    for a in range(3):
        y = scaled[a, 1] - scaled[a, 0] * xy / xx
        z = scaled[a, 2] - scaled[a, 0] * xz / xx - y * yz / yy
        zz += z * z
    rec[8] = math.sqrt(zz)


@njit(inline="always")
def _interval(centre, shift, root, factor, length):
    """Half-open range of indices i with |factor (i - centre) + shift| <= root, within 0..length."""
    middle, spread = centre - shift / factor, root / factor
    low, high = max(0.0, math.ceil(middle - spread)), min(length - 1.0, math.floor(middle + spread))
    if not low <= high:
        return 0, 0
    return int(low), int(high) + 1


@njit(inline="always")
def _slices(rec, cutoff, length):
    """The slices a Gaussian reaches; a two-dimensional one (r33 = 0) reaches all."""
    if rec[8] == 0.0:
        return 0, length
    return _interval(rec[2], 0.0, cutoff, rec[8], length)


@njit(nogil=True, cache=True, error_model="numpy")
def _set_up(start, stop, position, scale, rotation, first, spacing, record):
    white, scaled, rec = np.empty((3, 3)), np.empty((3, 3)), np.empty(9)
    for n in range(start, stop):
        _scaled(position, scale, rotation, n, first, spacing, white, scaled, rec)
        for k in range(9):
            record[n, k] = rec[k]


@njit(inline="always")
def _block(x0, r11, across, rest, cut, value):
    """``exp(-distance^2 / 2)`` of the voxels x0, x0 + 1, ... of one row, zero beyond the cut."""
    for k in range(_LANES):
        t = r11 * (np.float32(k) + x0) + across
        q = t * t + rest
        f = exp_negative(np.float32(-0.5) * (q if q < cut else cut))
        value[k] = f if q <= cut else np.float32(0)


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def _fill(first, last, record, weight, cutoff, ny, nx, volume):
    """Add every Gaussian to the slices first..last of ``volume`` (nz, ny, channels, padded nx)."""
    cut = np.float32(cutoff * cutoff)
    value = np.empty(_LANES, np.float32)
    nz = volume.shape[0]
    for n in range(len(record)):
        rec = record[n]
        xc, yc, zc, r11, r12, r13, r22, r23, r33 = rec
        low, high = _slices(rec, cutoff, nz)
        for iz in range(max(low, first), min(high, last)):
            z = np.float32(iz) - zc
            z2 = (r33 * z) * (r33 * z)
            y0, y1 = _interval(yc, r23 * z, math.sqrt(max(np.float32(0), cut - z2)), r22, ny)
            for iy in range(y0, y1):
                y = np.float32(iy) - yc
                up = r22 * y + r23 * z
                rest, across = z2 + up * up, r12 * y + r13 * z
                j0, j1 = _interval(xc, across, math.sqrt(max(np.float32(0), cut - rest)), r11, nx)
                for j in range(j0, j1, _LANES):
                    _block(np.float32(j) - xc, r11, across, rest, cut, value)
                    for c in range(len(weight)):
                        w = weight[c, n]
                        line = volume[iz, iy, c, j : j + _LANES]
                        for k in range(_LANES):
                            line[k] += w * value[k]


@njit(inline="always")
def _gather(n, rec, weight, cutoff, nx, grad_volume, value, total, sums, acc):
    """Lane sums over the voxels of one Gaussian: ``sums`` of dL/df f by channel, ``acc`` of h times
    (x, y, z, xx, xy, xz, yy, yz, zz) with h = dL/d(distance^2)."""
    cut = np.float32(cutoff * cutoff)
    half = np.float32(-0.5)
    xc, yc, zc, r11, r12, r13, r22, r23, r33 = rec
    nz, ny = grad_volume.shape[0], grad_volume.shape[1]
    low, high = _slices(rec, cutoff, nz)
    for iz in range(low, high):
        z = np.float32(iz) - zc
        z2 = (r33 * z) * (r33 * z)
        y0, y1 = _interval(yc, r23 * z, math.sqrt(max(np.float32(0), cut - z2)), r22, ny)
        for iy in range(y0, y1):
            y = np.float32(iy) - yc
            up = r22 * y + r23 * z
            rest, across = z2 + up * up, r12 * y + r13 * z
            j0, j1 = _interval(xc, across, math.sqrt(max(np.float32(0), cut - rest)), r11, nx)
            for j in range(j0, j1, _LANES):
                x0 = np.float32(j) - xc
                _block(x0, r11, across, rest, cut, value)
                total[:] = np.float32(0)
                for c in range(len(weight)):
                    w = weight[c, n]
                    line = grad_volume[iz, iy, c, j : j + _LANES]
                    channel = sums[c]
                    for k in range(_LANES):
                        channel[k] += line[k] * value[k]
                        total[k] += w * line[k]
                for k in range(_LANES):
                    x = np.float32(k) + x0
                    h = half * total[k] * value[k]
                    acc[0 * _LANES + k] += h * x
                    acc[1 * _LANES + k] += h * y
                    acc[2 * _LANES + k] += h * z
                    acc[3 * _LANES + k] += h * x * x
                    acc[4 * _LANES + k] += h * x * y
                    acc[5 * _LANES + k] += h * x * z
                    acc[6 * _LANES + k] += h * y * y
                    acc[7 * _LANES + k] += h * y * z
                    acc[8 * _LANES + k] += h * z * z


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def _gather_range(
    start, stop, position, scale, rotation, weight, first, spacing, cutoff, nx, grad_volume,
    grad_position, grad_scale, grad_rotation, grad_weight,
):  # fmt: skip
    """The gradients of the Gaussians start..stop."""
    white, scaled, rec, grad_white = np.empty((3, 3)), np.empty((3, 3)), np.empty(9), np.empty((3, 3))
    single = np.empty(9, np.float32)
    value, total = np.empty(_LANES, np.float32), np.empty(_LANES, np.float32)
    sums, acc = np.empty((len(weight), _LANES), np.float32), np.empty(9 * _LANES, np.float32)
    m = np.empty(9)
    order = np.array([[3, 4, 5], [4, 6, 7], [5, 7, 8]])
    for n in range(start, stop):
        _scaled(position, scale, rotation, n, first, spacing, white, scaled, rec)
        for k in range(9):
            single[k] = rec[k]
        sums[:] = np.float32(0)
        acc[:] = np.float32(0)
        _gather(n, single, weight, cutoff, nx, grad_volume, value, total, sums, acc)
        for k in range(9):
            m[k] = acc[k * _LANES : (k + 1) * _LANES].sum()
        for c in range(len(weight)):
            grad_weight[c, n] = sums[c].sum()
        for b in range(3):
            grad_position[n, b] = 0.0
        for a in range(3):
            # distance^2 = |A u|^2, A = W diag(spacing): dL/dA = 2 A sum(h u u^T), dL/dcentre = -2 A^T A sum(h u).
            ahead = scaled[a, 0] * m[0] + scaled[a, 1] * m[1] + scaled[a, 2] * m[2]
            for b in range(3):
                grad_position[n, b] -= 2 * ahead * white[a, b]
                row = (
                    scaled[a, 0] * m[order[0, b]]
                    + scaled[a, 1] * m[order[1, b]]
                    + scaled[a, 2] * m[order[2, b]]
                )
                grad_white[a, b] = 2 * row * spacing[b]
        whitening_adjoint(scale, rotation, n, white, grad_white, grad_scale, grad_rotation)


def forward(position, scale, rotation, weight, box: VoxelBox, cutoff: float) -> np.ndarray:
    """Volume (channels, nz, ny, nx) float32; arguments as for the reference, as float32 numpy arrays."""
    nz, ny, nx = box.shape
    record = np.empty((len(position), 9), np.float32)
    scene = (position, scale, rotation, box.first, box.spacing)
    run_tasks(lambda a, b: _set_up(a, b, *scene, record), split_range(len(position), 4 * cpu_threads()))
    volume = np.zeros((nz, ny, len(weight), nx + _LANES), np.float32)
    tasks = split_range(nz, 2 * cpu_threads())
    run_tasks(lambda a, b: _fill(a, b, record, weight, cutoff, ny, nx, volume), tasks)
    return volume[..., :nx].transpose(2, 0, 1, 3)


def backward(position, scale, rotation, weight, box: VoxelBox, cutoff: float, grad_volume: np.ndarray):
    """Gradients of position, scale, rotation and weight for ``grad_volume`` (channels, nz, ny, nx)."""
    nz, ny, nx = box.shape
    padded = np.zeros((nz, ny, len(weight), nx + _LANES), np.float32)
    padded[..., :nx] = grad_volume.transpose(1, 2, 0, 3)
    grads = tuple(np.zeros_like(a) for a in (position, scale, rotation, weight))
    scene = (position, scale, rotation, weight, box.first, box.spacing, cutoff, nx, padded)
    run_tasks(
        lambda a, b: _gather_range(a, b, *scene, *grads), split_range(len(position), 16 * cpu_threads())
    )
    return grads
