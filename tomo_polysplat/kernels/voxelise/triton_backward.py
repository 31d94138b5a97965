"""The adjoint of voxelising on CUDA: every Gaussian gathers the gradients of its voxels, without atomics.

One warp sums over the voxels of a Gaussian (``moments``); a second kernel, with one lane a Gaussian, takes
these sums back to position, scale and rotation.
"""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.triton_maths import HALF_LOG2E, dot, on_device, whitening_adjoint
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.kernels.voxelise.triton_setup import RECORD, scaled_whitening

__all__ = ["BLOCK", "pull_back", "sum_moments"]

BLOCK = (8, 4)  # rows and columns of the lanes that walk along the rows of an ellipsoid
_RUN = 4  # neighbours in the list handled by one warp: their voxels overlap, so they stay in the cache
_GAUSSIANS = 64
_MOMENTS = tl.constexpr(16)


@triton.jit
def _indices(centre, half, length):
    """First index and number of indices within ``half`` of ``centre``."""
    low = tl.math.ceil(tl.minimum(tl.maximum(centre - half, 0.0), length + 0.0)).to(tl.int32)
    high = tl.math.floor(tl.minimum(tl.maximum(centre + half, -1.0), length - 1.0)).to(tl.int32)
    return low, tl.maximum(high - low + 1, 0)


@triton.jit
def _moments_kernel(
    record, grad, moments, count, nz, ny, nx, stride, cut,
    CHANNELS: tl.constexpr, BLOCK_H: tl.constexpr, BLOCK_W: tl.constexpr, RUN: tl.constexpr,
):  # fmt: skip
    down, across = tl.arange(0, BLOCK_H)[:, None], tl.arange(0, BLOCK_W)[None, :]
    zero = tl.zeros([BLOCK_H, BLOCK_W], tl.float32)
    w1, w2, w3 = 0.0, 0.0, 0.0
    at = record + tl.program_id(0).to(tl.int64) * RUN * RECORD
    to = moments + tl.program_id(0).to(tl.int64) * RUN * _MOMENTS
    for _ in range(tl.program_id(0) * RUN, tl.minimum(count, tl.program_id(0) * RUN + RUN)):
        xc, yc, zc = tl.load(at), tl.load(at + 1), tl.load(at + 2)
        r11, r12, r13 = tl.load(at + 3), tl.load(at + 4), tl.load(at + 5)
        r22, r23, r33 = tl.load(at + 6), tl.load(at + 7), tl.load(at + 8)
        w0 = tl.load(at + 12)
        if CHANNELS > 1:
            w1 = tl.load(at + 13)
        if CHANNELS > 2:
            w2 = tl.load(at + 14)
        if CHANNELS > 3:
            w3 = tl.load(at + 15)
        hx, hy, hz, hxx, hxy = zero, zero, zero, zero, zero
        hxz, hyy, hyz, hzz = zero, zero, zero, zero
        c0, c1, c2, c3 = zero, zero, zero, zero
        first_y, lines = _indices(yc, tl.load(at + 10), ny)
        first_z, slices = _indices(zc, tl.load(at + 11), nz)
        for first in range(0, lines * slices, BLOCK_H):
            line = first + down
            known = line < lines * slices
            iy, iz = first_y + line % lines, first_z + line // lines
            y, z = iy.to(tl.float32) - yc, iz.to(tl.float32) - zc
            shift, up, out = r12 * y + r13 * z, r22 * y + r23 * z, r33 * z
            rest = up * up + out * out
            spread = tl.sqrt(tl.maximum(cut - rest, 0.0)) / r11 + 0.01
            start = tl.minimum(tl.maximum(xc - shift / r11 - spread, 0.0), nx + 0.0)
            start = tl.math.ceil(start).to(tl.int32)
            wide = tl.where(known & (rest <= cut), tl.minimum(2 * spread, nx - 1.0), -1.0)
            widest = tl.max(tl.max(wide, 1), 0)
            at_line = grad + (iz.to(tl.int64) * ny + iy) * nx
            h0, h1, h2 = zero, zero, zero
            for step in range(0, tl.math.floor(widest).to(tl.int32) + 1, BLOCK_W):
                j = start + (step + across)
                inside = (j < nx) & known
                x = j.to(tl.float32) - xc
                t = r11 * x + shift
                minus = -rest - t * t
                value = tl.where(minus >= -cut, tl.exp2(minus), 0.0)
                g = tl.load(at_line + j, mask=inside, other=0.0)
                total = w0 * g
                c0 += g * value
                if CHANNELS > 1:
                    g = tl.load(at_line + stride + j, mask=inside, other=0.0)
                    total += w1 * g
                    c1 += g * value
                if CHANNELS > 2:
                    g = tl.load(at_line + stride + stride + j, mask=inside, other=0.0)
                    total += w2 * g
                    c2 += g * value
                if CHANNELS > 3:
                    g = tl.load(at_line + stride + stride + stride + j, mask=inside, other=0.0)
                    total += w3 * g
                    c3 += g * value
                h = total * value
                along = h * x
                h0 += h
                h1 += along
                h2 += along * x
            hx += h1
            hy += h0 * y
            hz += h0 * z
            hxx += h2
            hxy += h1 * y
            hxz += h1 * z
            hyy += h0 * (y * y)
            hyz += h0 * (y * z)
            hzz += h0 * (z * z)
        tl.store(to, tl.sum(hx))
        tl.store(to + 1, tl.sum(hy))
        tl.store(to + 2, tl.sum(hz))
        tl.store(to + 3, tl.sum(hxx))
        tl.store(to + 4, tl.sum(hxy))
        tl.store(to + 5, tl.sum(hxz))
        tl.store(to + 6, tl.sum(hyy))
        tl.store(to + 7, tl.sum(hyz))
        tl.store(to + 8, tl.sum(hzz))
        tl.store(to + 12, tl.sum(c0))
        if CHANNELS > 1:
            tl.store(to + 13, tl.sum(c1))
        if CHANNELS > 2:
            tl.store(to + 14, tl.sum(c2))
        if CHANNELS > 3:
            tl.store(to + 15, tl.sum(c3))
        at += RECORD
        to += _MOMENTS


def sum_moments(record, grad_volume: torch.Tensor, box: VoxelBox, cutoff: float) -> torch.Tensor:
    """(count, 16) sums over the voxels of each ellipsoid, with x, y, z from its centre in voxels.

    First of h (x, y, z, x^2, xy, xz, y^2, yz, z^2) with dL/d(distance^2) = -h / 2, from 12 of f dL/df by
    channel.
    """
    moments = record.new_empty((len(record), _MOMENTS.value))
    grad = grad_volume.contiguous()
    with on_device(record):
        _moments_kernel[(triton.cdiv(len(record), _RUN),)](
            record, grad, moments, len(record), *box.shape, grad.stride(0), cutoff * cutoff * HALF_LOG2E,
            CHANNELS=len(grad), BLOCK_H=BLOCK[0], BLOCK_W=BLOCK[1], RUN=_RUN, num_warps=1, num_stages=1,
        )  # fmt: skip
    return moments


@triton.jit
def _row_gradient(a0, a1, a2, x, y, z, xx, xy, xz, yy, yz, zz, t0, t1, t2, s, sx, sy, sz):
    """One row of dL/dW, and what the row of W adds to dL/dposition."""
    ahead = dot(a0, a1, a2, x, y, z)
    return (
        -dot(a0, a1, a2, xx, xy, xz) * sx,
        -dot(a0, a1, a2, xy, yy, yz) * sy,
        -dot(a0, a1, a2, xz, yz, zz) * sz,
        ahead * t0 / s, ahead * t1 / s, ahead * t2 / s,
    )  # fmt: skip


@triton.jit
def _pull_back_kernel(
    scale, rotation, table, moments, grad_position, grad_scale, grad_rotation, grad_weight, count,
    CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = n < count
    (
        t00, t01, t02, t10, t11, t12, t20, t21, t22,
        a00, a01, a02, a10, a11, a12, a20, a21, a22, s0, s1, s2,
    ) = scaled_whitening(scale, rotation, table, n, live)  # fmt: skip
    at = moments + n * _MOMENTS
    x = tl.load(at, mask=live, other=0.0).to(tl.float64)
    y = tl.load(at + 1, mask=live, other=0.0).to(tl.float64)
    z = tl.load(at + 2, mask=live, other=0.0).to(tl.float64)
    xx = tl.load(at + 3, mask=live, other=0.0).to(tl.float64)
    xy = tl.load(at + 4, mask=live, other=0.0).to(tl.float64)
    xz = tl.load(at + 5, mask=live, other=0.0).to(tl.float64)
    yy = tl.load(at + 6, mask=live, other=0.0).to(tl.float64)
    yz = tl.load(at + 7, mask=live, other=0.0).to(tl.float64)
    zz = tl.load(at + 8, mask=live, other=0.0).to(tl.float64)
    sx, sy, sz = tl.load(table + 3), tl.load(table + 4), tl.load(table + 5)
    # distance^2 = |A u|^2: dL/dA = -A sum(h u u^T), dL/dposition = W^T A sum(h u).
    g00, g01, g02, p0, p1, p2 = _row_gradient(
        a00, a01, a02, x, y, z, xx, xy, xz, yy, yz, zz, t00, t01, t02, s0, sx, sy, sz
    )
    g10, g11, g12, q0, q1, q2 = _row_gradient(
        a10, a11, a12, x, y, z, xx, xy, xz, yy, yz, zz, t10, t11, t12, s1, sx, sy, sz
    )
    g20, g21, g22, o0, o1, o2 = _row_gradient(
        a20, a21, a22, x, y, z, xx, xy, xz, yy, yz, zz, t20, t21, t22, s2, sx, sy, sz
    )
    tl.store(grad_position + n * 3, (p0 + q0 + o0).to(tl.float32), mask=live)
    tl.store(grad_position + n * 3 + 1, (p1 + q1 + o1).to(tl.float32), mask=live)
    tl.store(grad_position + n * 3 + 2, (p2 + q2 + o2).to(tl.float32), mask=live)
    for k in tl.static_range(CHANNELS):
        tl.store(grad_weight + k * count + n, tl.load(at + 12 + k, mask=live, other=0.0), mask=live)
    whitening_adjoint(
        scale, rotation, n, live,
        t00 / s0, t01 / s0, t02 / s0, t10 / s1, t11 / s1, t12 / s1, t20 / s2, t21 / s2, t22 / s2,
        g00, g01, g02, g10, g11, g12, g20, g21, g22, grad_scale, grad_rotation,
    )  # fmt: skip


def pull_back(position, scale, rotation, weight, table: torch.Tensor, moments):
    """Gradients of position, scale, rotation and weight from the moments."""
    grads = tuple(torch.empty_like(t) for t in (position, scale, rotation, weight))
    with on_device(position):
        _pull_back_kernel[(triton.cdiv(len(position), _GAUSSIANS),)](
            scale, rotation, table, moments, *grads, len(position),
            CHANNELS=len(weight), BLOCK=_GAUSSIANS, num_warps=2,
        )  # fmt: skip
    return grads
