"""The adjoint of voxelising on CUDA: every Gaussian gathers the gradients of its voxels, without atomics.

Four lanes walk along the lines of an ellipsoid (``moments``); a second kernel, with one lane a Gaussian, takes
these sums back to position, scale and rotation.
"""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.triton_lanes import SUMS, load_four, store_sums
from tomo_polysplat.kernels.triton_maths import (
    HALF_LOG2E,
    SIZES,
    dot,
    load_shape,
    on_device,
    whitening_adjoint,
)
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.kernels.voxelise.triton_setup import RECORD, ROOT, scaled_whitening, triangle

__all__ = ["pull_back", "sum_moments"]

_GAUSSIANS = 64
_FAR = tl.constexpr(1 << 22)


@triton.jit
def _range(middle, half, length):
    """First index within ``half`` of ``middle`` and where the indices end, both as floats."""
    first = tl.math.ceil(tl.minimum(tl.maximum(middle - half, 0.0), length + 0.0))
    return first, tl.minimum(middle + half, length - 0.5)


@triton.jit
def _longest(first, last):
    """How many indices the longest of the ranges has."""
    return tl.max((last - first + 1.0).to(tl.int32), 0)


@triton.jit(do_not_specialize=SIZES)
def _voxel_moments_kernel(record, grad, moments, count, nz, ny, nx, stride, cut, CHANNELS: tl.constexpr):
    lane = tl.arange(0, 32)
    n = tl.program_id(0) * 8 + lane // 4
    at = record + tl.minimum(n, count - 1).to(tl.int64) * RECORD
    xc, yc, zc, r11 = load_four(at)
    r12, r13, r22, r23 = load_four(at + 4)
    r33, half_x, half_y, half_z = load_four(at + 8)
    w0, w1, w2, w3 = load_four(at + 12)
    zero = tl.zeros([32], tl.float32)
    ht, hu, hv, htt, htu = zero, zero, zero, zero, zero
    htv, huu, huv, hvv = zero, zero, zero, zero
    c0, c1, c2, c3 = zero, zero, zero, zero
    by_r11, by_r22 = 1.0 / r11, 1.0 / r22
    # So far away x could not count voxels, and no Gaussian of a fit is.
    near = (
        (tl.abs(xc) < _FAR)
        & (xc + half_x >= 0)
        & (xc - half_x <= nx - 1)
        & (yc + half_y >= 0)
        & (yc - half_y <= ny - 1)
    )
    z_first, z_last = _range(zc, half_z, nz)
    z_last = tl.where(near & (n < count), z_last, -1.0)
    for slab in range(_longest(z_first, z_last)):
        # The ellipsoid's slab is an ellipse, its line a chord of that.
        iz = z_first + slab
        z = iz - zc
        out = r33 * z
        rest = cut - out * out
        y_first, y_last = _range(yc - r23 * z * by_r22, tl.sqrt(tl.maximum(rest, 0.0)) * by_r22, ny)
        y_last = tl.where((iz <= z_last) & (rest >= 0), y_last, -1.0)
        lines = tl.minimum(iz, nz - 1.0).to(tl.int64) * ny
        for turn in range(0, _longest(y_first, y_last), 4):
            iy = y_first + (turn + lane % 4)
            y = iy - yc
            shift, up = r12 * y + r13 * z, r22 * y + r23 * z
            rest = up * up + out * out
            first, last = _range(xc - shift * by_r11, tl.sqrt(tl.maximum(cut - rest, 0.0)) * by_r11, nx)
            last = tl.where(iy <= y_last, last, -1.0)
            voxel = grad + ((lines + tl.minimum(iy, ny - 1.0).to(tl.int32)) * nx + first.to(tl.int32))
            x = first - xc
            h0, h1 = zero, zero
            for _walked in range(_longest(first, last)):
                inside = x <= last - xc
                t = r11 * x + shift
                value = tl.where(inside, tl.exp2(-1.0 * (t * t + rest)), 0.0)
                g = tl.load(voxel, mask=inside, other=0.0)
                total = w0 * g
                c0 += g * value
                if CHANNELS > 1:
                    g = tl.load(voxel + stride, mask=inside, other=0.0)
                    total += w1 * g
                    c1 += g * value
                if CHANNELS > 2:
                    g = tl.load(voxel + stride + stride, mask=inside, other=0.0)
                    total += w2 * g
                    c2 += g * value
                if CHANNELS > 3:
                    g = tl.load(voxel + stride + stride + stride, mask=inside, other=0.0)
                    total += w3 * g
                    c3 += g * value
                h = total * value
                along = h * t
                h0 += h
                h1 += along
                htt += along * t
                x += 1.0
                voxel += 1
            ht += h1
            hu += h0 * up
            hv += h0 * out
            htu += h1 * up
            htv += h1 * out
            huu += h0 * (up * up)
            huv += h0 * (up * out)
            hvv += h0 * (out * out)
    store_sums(
        moments + n.to(tl.int64) * SUMS, n < count, lane,
        ht, hu, hv, htt, htu, htv, huu, huv, hvv, zero, zero, zero, c0, c1, c2, c3, LANES=4,
    )  # fmt: skip


def sum_moments(record, grad_volume: torch.Tensor, box: VoxelBox, cutoff: float) -> torch.Tensor:
    """(count, 16) sums over the voxels of each ellipsoid, with t, u, v the three terms of q in triton_setup.

    First of h (t, u, v, t^2, tu, tv, u^2, uv, v^2) with dL/d(distance^2) = -h / 2, from 12 of f dL/df by
    channel.
    """
    moments = record.new_empty((len(record), SUMS.value))
    grad = grad_volume.contiguous()
    with on_device(record):
        _voxel_moments_kernel[(triton.cdiv(len(record), 8),)](
            record, grad, moments, len(record), *box.shape, grad.stride(0), cutoff * cutoff * HALF_LOG2E,
            CHANNELS=len(grad), num_warps=1, num_stages=1,
        )  # fmt: skip
    return moments


@triton.jit
def _row_gradient(q0, q1, q2, r11, r12, r13, r22, r23, r33, xx, xy, xz, yy, yz, zz):
    """One row of q M r^-T, by back substitution; without r33 nothing depends on z."""
    m0, m1, m2 = dot(q0, q1, q2, xx, xy, xz), dot(q0, q1, q2, xy, yy, yz), dot(q0, q1, q2, xz, yz, zz)
    g2 = tl.where(r33 > 0, m2 / tl.where(r33 > 0, r33, 1.0), 0.0)
    g1 = (m1 - r23 * g2) / r22
    return (m0 - r12 * g1 - r13 * g2) / r11, g1, g2


@triton.jit
def _store_zeros(to, n, live, NUMBERS: tl.constexpr):
    for k in tl.static_range(NUMBERS):
        tl.store(to + n * NUMBERS + k, tl.zeros(n.shape, tl.float32), mask=live)


@triton.jit(do_not_specialize=SIZES)
def _pull_back_kernel(
    scale, rotation, table, moments, grad_position, grad_scale, grad_rotation, grad_weight, count,
    CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = n < count
    most = tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(SUMS):
        most = tl.maximum(most, tl.abs(tl.load(moments + n * SUMS + k, mask=live, other=0.0)))
    # Of a whole volume's Gaussians, most are far from a small box.
    if tl.max(most, 0) > 0:
        _pull_back_block(
            scale, rotation, table, moments, grad_position, grad_scale, grad_rotation, grad_weight, n, live,
            count, CHANNELS,
        )  # fmt: skip
    else:
        _store_zeros(grad_position, n, live, 3)
        _store_zeros(grad_scale, n, live, 3)
        _store_zeros(grad_rotation, n, live, 4)
        for k in tl.static_range(CHANNELS):
            tl.store(grad_weight + k * count + n, tl.zeros([BLOCK], tl.float32), mask=live)


@triton.jit
def _pull_back_block(
    scale, rotation, table, moments, grad_position, grad_scale, grad_rotation, grad_weight, n, live, count,
    CHANNELS: tl.constexpr,
):  # fmt: skip
    known = tl.minimum(n, count - 1)
    s0, s1, s2, qw, qx, qy, qz = load_shape(scale, rotation, known)
    at = moments + known * SUMS
    t, u, v, tt = load_four(at)
    tu, tv, uu, uv = load_four(at + 4)
    vv, _, _, _ = load_four(at + 8)
    (
        t00, t01, t02, t10, t11, t12, t20, t21, t22,
        a00, a01, a02, a10, a11, a12, a20, a21, a22,
    ) = scaled_whitening(s0, s1, s2, qw, qx, qy, qz, table)  # fmt: skip
    r11, r12, r13, r22, r23, r33, q00, q10, q20, q01, q11, q21, q02, q12, q22 = triangle(
        a00, a01, a02, a10, a11, a12, a20, a21, a22
    )
    # distance^2 = t^2 + u^2 + v^2 in units of ROOT: dL/dA = -q M r^-T, dL/dposition = W^T q m.
    one, two = 1.0 / ROOT, -1.0 / (ROOT * ROOT)
    t, u, v = t.to(tl.float64) * one, u.to(tl.float64) * one, v.to(tl.float64) * one
    tt, tu, tv = tt.to(tl.float64) * two, tu.to(tl.float64) * two, tv.to(tl.float64) * two
    uu, uv, vv = uu.to(tl.float64) * two, uv.to(tl.float64) * two, vv.to(tl.float64) * two
    a, b, c = 1.0 / s0.to(tl.float64), 1.0 / s1.to(tl.float64), 1.0 / s2.to(tl.float64)
    m0, m1, m2 = (
        dot(q00, q01, q02, t, u, v) * a,
        dot(q10, q11, q12, t, u, v) * b,
        dot(q20, q21, q22, t, u, v) * c,
    )
    tl.store(grad_position + n * 3, dot(t00, t10, t20, m0, m1, m2).to(tl.float32), mask=live)
    tl.store(grad_position + n * 3 + 1, dot(t01, t11, t21, m0, m1, m2).to(tl.float32), mask=live)
    tl.store(grad_position + n * 3 + 2, dot(t02, t12, t22, m0, m1, m2).to(tl.float32), mask=live)
    sx, sy, sz = tl.load(table + 3), tl.load(table + 4), tl.load(table + 5)
    g00, g01, g02 = _row_gradient(q00, q01, q02, r11, r12, r13, r22, r23, r33, tt, tu, tv, uu, uv, vv)
    g10, g11, g12 = _row_gradient(q10, q11, q12, r11, r12, r13, r22, r23, r33, tt, tu, tv, uu, uv, vv)
    g20, g21, g22 = _row_gradient(q20, q21, q22, r11, r12, r13, r22, r23, r33, tt, tu, tv, uu, uv, vv)
    for k in tl.static_range(CHANNELS):
        tl.store(grad_weight + k * count + n, tl.load(at + 12 + k), mask=live)
    whitening_adjoint(
        s0, s1, s2, qw, qx, qy, qz, n, live,
        t00 * a, t01 * a, t02 * a, t10 * b, t11 * b, t12 * b, t20 * c, t21 * c, t22 * c,
        g00 * sx, g01 * sy, g02 * sz, g10 * sx, g11 * sy, g12 * sz, g20 * sx, g21 * sy, g22 * sz,
        grad_scale, grad_rotation,
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
