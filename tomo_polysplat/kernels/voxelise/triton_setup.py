"""Ellipsoids: what the Triton kernels need of a Gaussian in a grid of voxels, computed once.

README.md has the formulas.

With x, y, z counted in voxels from the Gaussian's centre, q = HALF_LOG2E times the squared distance is
(r11 x + r12 y + r13 z)^2 + (r22 y + r23 z)^2 + (r33 z)^2.

``record`` (count, 16): 0-2 the centre (x, y, z) in voxels; 3-8 r11, r12, r13, r22, r23, r33; 9-11 the
half-widths of the bounding box along x, y, z; 12-15 the weights.
"""

from __future__ import annotations

import numpy as np
import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.triton_lanes import store_four
from tomo_polysplat.kernels.triton_maths import (
    HALF_LOG2E,
    SIZES,
    dot,
    load_shape,
    load_three,
    on_device,
    rotation_matrix,
)
from tomo_polysplat.kernels.voxelise.box import VoxelBox

__all__ = ["RECORD", "ROOT", "box_table", "ellipsoids", "scaled_whitening", "triangle"]

RECORD = tl.constexpr(16)
ROOT = tl.constexpr(HALF_LOG2E**0.5)
_SLACK = tl.constexpr(0.01)  # of a voxel, on the bounding box: rounding must not cut what q still includes
_BLOCK = 128


def box_table(box: VoxelBox, device: torch.device) -> torch.Tensor:
    """(6,) float64 first centre and spacing; copied without waiting for the device."""
    table = np.concatenate([box.first, box.spacing]).astype(np.float64)
    return torch.from_numpy(table).to(device, non_blocking=True)


@triton.jit
def scaled_whitening(s0, s1, s2, w, x, y, z, table):
    """R^T row by row, then ``A = diag(1/scale) R^T diag(spacing)`` row by row, in float64."""
    t00, t01, t02, t10, t11, t12, t20, t21, t22 = rotation_matrix(w, x, y, z)
    x, y, z = tl.load(table + 3), tl.load(table + 4), tl.load(table + 5)
    a, b, c = 1.0 / s0.to(tl.float64), 1.0 / s1.to(tl.float64), 1.0 / s2.to(tl.float64)
    return (
        t00, t01, t02, t10, t11, t12, t20, t21, t22,
        t00 * a * x, t01 * a * y, t02 * a * z, t10 * b * x, t11 * b * y, t12 * b * z,
        t20 * c * x, t21 * c * y, t22 * c * z,
    )  # fmt: skip


@triton.jit
def triangle(a00, a01, a02, a10, a11, a12, a20, a21, a22):
    """A = q r: r11, r12, r13, r22, r23, r33 and the columns of q, the third zero where r33 is.

    What is left of y and z across x is kept as vectors: squares subtracted afterwards would cancel.
    """
    xx = dot(a00, a10, a20, a00, a10, a20)
    by_r11 = tl.math.rsqrt(xx)
    x0, x1, x2 = a00 * by_r11, a10 * by_r11, a20 * by_r11
    r12, r13 = dot(x0, x1, x2, a01, a11, a21), dot(x0, x1, x2, a02, a12, a22)
    y0, y1, y2 = a01 - x0 * r12, a11 - x1 * r12, a21 - x2 * r12
    yy = dot(y0, y1, y2, y0, y1, y2)
    by_r22 = tl.math.rsqrt(yy)
    y0, y1, y2 = y0 * by_r22, y1 * by_r22, y2 * by_r22
    z0, z1, z2 = a02 - x0 * r13, a12 - x1 * r13, a22 - x2 * r13
    r23 = dot(y0, y1, y2, z0, z1, z2)
    z0, z1, z2 = z0 - y0 * r23, z1 - y1 * r23, z2 - y2 * r23
    zz = dot(z0, z1, z2, z0, z1, z2)
    by_r33 = tl.where(zz > 0, tl.math.rsqrt(tl.where(zz > 0, zz, 1.0)), 0.0)
    r11, r22, r33 = xx * by_r11, yy * by_r22, zz * by_r33
    return (
        r11, r12, r13, r22, r23, r33, x0, x1, x2, y0, y1, y2, z0 * by_r33, z1 * by_r33, z2 * by_r33,
    )  # fmt: skip


@triton.jit
def _centre(p, table, axis):
    return (p.to(tl.float64) - tl.load(table + axis)) / tl.load(table + 3 + axis)


@triton.jit
def _reach(t0, t1, t2, s0, s1, s2):
    """Length of one column of S R^T; zero, not NaN, where an infinite scale does not turn into the axis."""
    a = tl.where(t0 != 0, t0 * s0, 0.0)
    b = tl.where(t1 != 0, t1 * s1, 0.0)
    c = tl.where(t2 != 0, t2 * s2, 0.0)
    return tl.sqrt(a * a + b * b + c * c)


@triton.jit
def _store(at, a, b, c, d, live):
    store_four(at, a.to(tl.float32), b.to(tl.float32), c.to(tl.float32), d.to(tl.float32), live)


@triton.jit
def _weight(weight, n, count, k, CHANNELS: tl.constexpr):
    if k < CHANNELS:
        return tl.load(weight + k * count + n)
    return tl.zeros(n.shape, tl.float32)


@triton.jit(do_not_specialize=SIZES)
def _ellipsoid_kernel(
    position, scale, rotation, weight, table, record, count, cutoff,
    CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = n < count
    known = tl.minimum(n, count - 1)
    s0, s1, s2, qw, qx, qy, qz = load_shape(scale, rotation, known)
    p0, p1, p2 = load_three(position, known)
    w0, w1 = _weight(weight, known, count, 0, CHANNELS), _weight(weight, known, count, 1, CHANNELS)
    w2, w3 = _weight(weight, known, count, 2, CHANNELS), _weight(weight, known, count, 3, CHANNELS)
    (
        t00, t01, t02, t10, t11, t12, t20, t21, t22,
        a00, a01, a02, a10, a11, a12, a20, a21, a22,
    ) = scaled_whitening(s0, s1, s2, qw, qx, qy, qz, table)  # fmt: skip
    r11, r12, r13, r22, r23, r33, _, _, _, _, _, _, _, _, _ = triangle(
        a00, a01, a02, a10, a11, a12, a20, a21, a22
    )
    x = cutoff * _reach(t00, t10, t20, s0, s1, s2) / tl.load(table + 3) + _SLACK
    y = cutoff * _reach(t01, t11, t21, s0, s1, s2) / tl.load(table + 4) + _SLACK
    z = cutoff * _reach(t02, t12, t22, s0, s1, s2) / tl.load(table + 5) + _SLACK
    to = record + n * RECORD
    cx, cy, cz = _centre(p0, table, 0), _centre(p1, table, 1), _centre(p2, table, 2)
    _store(to, cx, cy, cz, r11 * ROOT, live)
    _store(to + 4, r12 * ROOT, r13 * ROOT, r22 * ROOT, r23 * ROOT, live)
    _store(to + 8, r33 * ROOT, x, y, z, live)
    store_four(to + 12, w0, w1, w2, w3, live)


def ellipsoids(position, scale, rotation, weight, table: torch.Tensor, cutoff: float) -> torch.Tensor:
    """``record`` of the module docstring."""
    count = len(position)
    record = position.new_empty((count, RECORD.value))
    if count:
        with on_device(position):
            _ellipsoid_kernel[(triton.cdiv(count, _BLOCK),)](
                position, scale, rotation, weight, table, record, count, cutoff,
                CHANNELS=len(weight), BLOCK=_BLOCK, num_warps=4,
            )  # fmt: skip
    return record
