"""Ellipsoids: what the Triton kernels need of a Gaussian in a grid of voxels, computed once.

README.md has the formulas.

With x, y, z counted in voxels from the Gaussian's centre, q = HALF_LOG2E times the squared distance is
(r11 x + r12 y + r13 z)^2 + (r22 y + r23 z)^2 + (r33 z)^2.

``record`` (count, 16): 0-2 the centre (x, y, z) in voxels; 3-8 r11, r12, r13, r22, r23, r33; 9-11 the
half-widths of the bounding box along x, y, z; 12-15 the weights. ``shape`` (9, count): its first nine, for
many Gaussians at a time. ``boxes`` (6, groups): lower and upper x, y, z of the bounding boxes of GROUP
neighbours in the list.
"""

from __future__ import annotations

import numpy as np
import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.triton_maths import GROUP, HALF_LOG2E, dot, on_device, rotation_matrix
from tomo_polysplat.kernels.voxelise.box import VoxelBox

__all__ = ["RECORD", "box_table", "ellipsoids", "scaled_whitening"]

RECORD = tl.constexpr(16)
_ROOT = tl.constexpr(HALF_LOG2E**0.5)
_SLACK = tl.constexpr(0.01)  # of a voxel, on the bounding box: rounding must not cut what q still includes
_BLOCK = 128


def box_table(box: VoxelBox, device: torch.device) -> torch.Tensor:
    """(6,) float64 first centre and spacing; copied without waiting for the device."""
    table = np.concatenate([box.first, box.spacing]).astype(np.float64)
    return torch.from_numpy(table).to(device, non_blocking=True)


@triton.jit
def scaled_whitening(scale, rotation, table, n, live):
    """R^T row by row, then ``A = diag(1/scale) R^T diag(spacing)`` row by row, then scale, in float64."""
    t00, t01, t02, t10, t11, t12, t20, t21, t22 = rotation_matrix(rotation, n, live)
    s0 = tl.load(scale + n * 3, mask=live, other=1.0).to(tl.float64)
    s1 = tl.load(scale + n * 3 + 1, mask=live, other=1.0).to(tl.float64)
    s2 = tl.load(scale + n * 3 + 2, mask=live, other=1.0).to(tl.float64)
    x, y, z = tl.load(table + 3), tl.load(table + 4), tl.load(table + 5)
    return (
        t00, t01, t02, t10, t11, t12, t20, t21, t22,
        t00 / s0 * x, t01 / s0 * y, t02 / s0 * z, t10 / s1 * x, t11 / s1 * y, t12 / s1 * z,
        t20 / s2 * x, t21 / s2 * y, t22 / s2 * z, s0, s1, s2,
    )  # fmt: skip


@triton.jit
def _centre(position, table, n, live, axis):
    p = tl.load(position + n * 3 + axis, mask=live, other=0.0).to(tl.float64)
    return (p - tl.load(table + axis)) / tl.load(table + 3 + axis)


@triton.jit
def _reach(t0, t1, t2, s0, s1, s2):
    """Length of one column of S R^T; zero, not NaN, where an infinite scale does not turn into the axis."""
    a = tl.where(t0 != 0, t0 * s0, 0.0)
    b = tl.where(t1 != 0, t1 * s1, 0.0)
    c = tl.where(t2 != 0, t2 * s2, 0.0)
    return tl.sqrt(a * a + b * b + c * c)


@triton.jit
def _store_axis(record, shape, boxes, n, live, count, groups, axis, centre, half, BLOCK, GROUP):
    tl.store(record + n * RECORD + axis, centre.to(tl.float32), mask=live)
    tl.store(record + n * RECORD + 9 + axis, half.to(tl.float32), mask=live)
    tl.store(shape + axis * count + n, centre.to(tl.float32), mask=live)
    split: tl.constexpr = [BLOCK // GROUP, GROUP]
    low = tl.min(tl.reshape(tl.where(live, centre - half, float("inf")), split), 1)
    high = tl.max(tl.reshape(tl.where(live, centre + half, -float("inf")), split), 1)
    g = tl.program_id(0) * (BLOCK // GROUP) + tl.arange(0, BLOCK // GROUP)
    tl.store(boxes + axis * groups + g, low.to(tl.float32), mask=g < groups)
    tl.store(boxes + (3 + axis) * groups + g, high.to(tl.float32), mask=g < groups)


@triton.jit
def _store_factor(record, shape, n, live, count, k, factor):
    single = (factor * _ROOT).to(tl.float32)
    tl.store(record + n * RECORD + k, single, mask=live)
    tl.store(shape + k * count + n, single, mask=live)


@triton.jit
def _ellipsoid_kernel(
    position, scale, rotation, weight, table, record, shape, boxes, count, groups, cutoff,
    CHANNELS: tl.constexpr, BLOCK: tl.constexpr, GROUP: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = n < count
    (
        t00, t01, t02, t10, t11, t12, t20, t21, t22,
        a00, a01, a02, a10, a11, a12, a20, a21, a22, s0, s1, s2,
    ) = scaled_whitening(scale, rotation, table, n, live)  # fmt: skip
    # The triangle of A's QR factors. What is left of y and z across x is kept as vectors: squares subtracted
    # afterwards would cancel.
    xx = dot(a00, a10, a20, a00, a10, a20)
    xy, xz = dot(a00, a10, a20, a01, a11, a21), dot(a00, a10, a20, a02, a12, a22)
    y0, y1, y2 = a01 - a00 * xy / xx, a11 - a10 * xy / xx, a21 - a20 * xy / xx
    z0, z1, z2 = a02 - a00 * xz / xx, a12 - a10 * xz / xx, a22 - a20 * xz / xx
    yy, yz = dot(y0, y1, y2, y0, y1, y2), dot(y0, y1, y2, z0, z1, z2)
    z0, z1, z2 = z0 - y0 * yz / yy, z1 - y1 * yz / yy, z2 - y2 * yz / yy
    r11, r22 = tl.sqrt(xx), tl.sqrt(yy)
    _store_factor(record, shape, n, live, count, 3, r11)
    _store_factor(record, shape, n, live, count, 4, xy / r11)
    _store_factor(record, shape, n, live, count, 5, xz / r11)
    _store_factor(record, shape, n, live, count, 6, r22)
    _store_factor(record, shape, n, live, count, 7, yz / r22)
    _store_factor(record, shape, n, live, count, 8, tl.sqrt(dot(z0, z1, z2, z0, z1, z2)))
    x = cutoff * _reach(t00, t10, t20, s0, s1, s2) / tl.load(table + 3) + _SLACK
    y = cutoff * _reach(t01, t11, t21, s0, s1, s2) / tl.load(table + 4) + _SLACK
    z = cutoff * _reach(t02, t12, t22, s0, s1, s2) / tl.load(table + 5) + _SLACK
    cx, cy = _centre(position, table, n, live, 0), _centre(position, table, n, live, 1)
    _store_axis(record, shape, boxes, n, live, count, groups, 0, cx, x, BLOCK, GROUP)
    _store_axis(record, shape, boxes, n, live, count, groups, 1, cy, y, BLOCK, GROUP)
    cz = _centre(position, table, n, live, 2)
    _store_axis(record, shape, boxes, n, live, count, groups, 2, cz, z, BLOCK, GROUP)
    for k in tl.static_range(CHANNELS):
        height = tl.load(weight + k * count + n, mask=live, other=0.0)
        tl.store(record + n * RECORD + 12 + k, height, mask=live)


def ellipsoids(position, scale, rotation, weight, table: torch.Tensor, cutoff: float):
    """``record``, ``shape`` and ``boxes`` of the module docstring."""
    count, groups = len(position), triton.cdiv(len(position), GROUP)
    record = position.new_empty((count, RECORD.value))
    shape = position.new_empty((9, count))
    boxes = position.new_empty((6, groups))
    if count:
        with on_device(position):
            _ellipsoid_kernel[(triton.cdiv(count, _BLOCK),)](
                position, scale, rotation, weight, table, record, shape, boxes, count, groups, cutoff,
                CHANNELS=len(weight), BLOCK=_BLOCK, GROUP=GROUP, num_warps=4,
            )  # fmt: skip
    return record, shape, boxes
