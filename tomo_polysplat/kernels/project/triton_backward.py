"""The adjoint of the projection on CUDA: every Gaussian gathers the gradients of its pixels, without atomics.

One warp sums over the pixels of a Gaussian in a view (``moments``); a second kernel, with one lane a Gaussian, takes
these sums through the formulas of the footprint back to position, scale and rotation and adds up the views.
"""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.project.triton_forward import footprint_value
from tomo_polysplat.kernels.project.triton_setup import RECORD, VIEW, chain, whitening
from tomo_polysplat.kernels.triton_maths import HALF_LOG2E, cross, dot, on_device, whitening_adjoint
from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["BLOCK", "pull_back", "sum_moments"]

BLOCK = (8, 4)  # rows and columns of the lanes that walk along the rows of a footprint
_RUN = 4  # neighbours in the list handled by one warp: their pixels overlap, so they stay in the cache
_GAUSSIANS = 64
_MOMENTS = tl.constexpr(16)
_TWO_LN2 = tl.constexpr(1 / HALF_LOG2E)


@triton.jit
def _pixel_gradients(line, j, inside, CHANNELS: tl.constexpr):
    """The channels' gradients of pixels ``j`` of rows; several channels lie in fours, read with one instruction."""
    if CHANNELS == 1:
        g0 = tl.load(line + j, mask=inside, other=0.0)
        return g0, g0, g0, g0
    at = line[:, :, None] + (j[:, :, None] * 4 + tl.arange(0, 4)[None, None, :])
    four = tl.load(at, mask=tl.broadcast_to(inside[:, :, None], at.shape), other=0.0)
    even, odd = tl.split(tl.reshape(four, [four.shape[0], four.shape[1], 2, 2]))
    g0, g2 = tl.split(even)
    g1, g3 = tl.split(odd)
    return g0, g1, g2, g3


@triton.jit
def _moments_kernel(
    record, ellipse, grad, moments, count, rows, columns, cut,
    CHANNELS: tl.constexpr, CONE: tl.constexpr, BLOCK_H: tl.constexpr, BLOCK_W: tl.constexpr, RUN: tl.constexpr,
):  # fmt: skip
    view = tl.program_id(1).to(tl.int64)
    SPREAD: tl.constexpr = 1 if CHANNELS == 1 else 4
    grad += view * rows * columns * SPREAD
    down, across = tl.arange(0, BLOCK_H)[:, None], tl.arange(0, BLOCK_W)[None, :]
    zero = tl.zeros([BLOCK_H, BLOCK_W], tl.float32)
    lx, ly, lxx, lxy, lyy = 0.0, 0.0, 0.0, 0.0, 0.0
    w1, w2, w3 = 0.0, 0.0, 0.0
    for n in range(tl.program_id(0) * RUN, tl.minimum(count, tl.program_id(0) * RUN + RUN)):
        outline = ellipse + view * 5 * count + n
        yc, ry, xc = tl.load(outline), tl.load(outline + count), tl.load(outline + 2 * count)
        m, hx = tl.load(outline + 3 * count), tl.load(outline + 4 * count)
        at = record + (view * count + n) * RECORD
        column0, row0 = tl.load(at), tl.load(at + 1)
        r11, r12, r22 = tl.load(at + 2), tl.load(at + 3), tl.load(at + 4)
        if CONE:
            lx, ly = tl.load(at + 5), tl.load(at + 6)
            lxx, lxy, lyy = tl.load(at + 7), tl.load(at + 8), tl.load(at + 9)
        w0 = tl.load(at + 11)
        if CHANNELS > 1:
            w1 = tl.load(at + 12)
        if CHANNELS > 2:
            w2 = tl.load(at + 13)
        if CHANNELS > 3:
            w3 = tl.load(at + 14)
        hx_, hy_, hxx_, hxy_, hyy_ = zero, zero, zero, zero, zero
        s_, sx_, sy_, sxx_, sxy_, syy_ = zero, zero, zero, zero, zero, zero
        c0, c1, c2, c3 = zero, zero, zero, zero
        low = tl.math.ceil(tl.maximum(yc - ry, 0.0)).to(tl.int32)
        high = tl.math.floor(tl.minimum(yc + ry, rows - 1.0)).to(tl.int32)
        for first in range(low, high + 1, BLOCK_H):
            i = first + down
            row = i.to(tl.float32)
            line = grad + i.to(tl.int64) * columns * SPREAD
            offset, y = row - yc, row - row0
            u = offset / ry
            start = xc + m * offset - hx * tl.sqrt(tl.maximum(1.0 - u * u, 0.0))
            start = tl.math.ceil(tl.minimum(tl.maximum(start, 0.0), columns + 0.0)).to(tl.int32)
            # As many columns as the widest of these rows, the one nearest to the middle.
            top = first + 0.0
            u = tl.minimum(tl.maximum(yc, top), top + (BLOCK_H - 1)) - yc
            u = u / ry
            wide = 2 * hx * tl.sqrt(tl.maximum(1.0 - u * u, 0.0))
            width = tl.minimum(wide, columns - 1.0).to(tl.int32) + 1
            h0, h1, h2, s0, s1, s2 = zero, zero, zero, zero, zero, zero
            for step in range(0, width, BLOCK_W):
                j = start + (step + across)
                inside = (j < columns) & (i <= high)
                x = j.to(tl.float32) - column0
                value, minus, inverse = footprint_value(x, y, r11, r12, r22, lx, ly, lxx, lxy, lyy, cut, CONE)
                g0, g1, g2, g3 = _pixel_gradients(line, j, inside, CHANNELS)
                total = w0 * g0
                c0 += g0 * value
                if CHANNELS > 1:
                    total += w1 * g1
                    c1 += g1 * value
                if CHANNELS > 2:
                    total += w2 * g2
                    c2 += g2 * value
                if CHANNELS > 3:
                    total += w3 * g3
                    c3 += g3 * value
                h = total * value * inverse
                along = h * x
                h0 += h
                h1 += along
                h2 += along * x
                s = h + h * (minus * _TWO_LN2)
                s0 += s
                if CONE:
                    along = s * x
                    s1 += along
                    s2 += along * x
            hx_ += h1
            hy_ += h0 * y
            hxx_ += h2
            hxy_ += h1 * y
            hyy_ += h0 * (y * y)
            s_ += s0
            if CONE:
                sx_ += s1
                sy_ += s0 * y
                sxx_ += s2
                sxy_ += s1 * y
                syy_ += s0 * (y * y)
        out = moments + (view * count + n) * _MOMENTS
        tl.store(out, tl.sum(hx_))
        tl.store(out + 1, tl.sum(hy_))
        tl.store(out + 2, tl.sum(hxx_))
        tl.store(out + 3, tl.sum(hxy_))
        tl.store(out + 4, tl.sum(hyy_))
        tl.store(out + 5, tl.sum(s_))
        if CONE:
            tl.store(out + 6, tl.sum(sx_))
            tl.store(out + 7, tl.sum(sy_))
            tl.store(out + 8, tl.sum(sxx_))
            tl.store(out + 9, tl.sum(sxy_))
            tl.store(out + 10, tl.sum(syy_))
        tl.store(out + 11, tl.sum(c0))
        if CHANNELS > 1:
            tl.store(out + 12, tl.sum(c1))
        if CHANNELS > 2:
            tl.store(out + 13, tl.sum(c2))
        if CHANNELS > 3:
            tl.store(out + 14, tl.sum(c3))


def sum_moments(record, ellipse, grad_image: torch.Tensor, views: DetectorViews, cutoff: float) -> torch.Tensor:
    """(views, count, 16) sums over each footprint, x and y from the projected centre: of h times (x, y, x^2, xy, y^2),
    of s times (1, x, y, x^2, xy, y^2), of f dL/df by channel; with -2 h = dL/d(distance^2 |e|^2) and -2 s =
    dL/d|e|^2, all in units of |e_centre|."""
    channels, (many, count) = len(grad_image), record.shape[:2]
    moments = record.new_empty((many, count, _MOMENTS.value))
    pixels = grad_image.permute(1, 2, 3, 0)
    if channels > 1:
        pixels = torch.nn.functional.pad(pixels, (0, 4 - channels))
    with on_device(record):
        _moments_kernel[(triton.cdiv(count, _RUN), many)](
            record, ellipse, pixels.contiguous(), moments, count, views.rows, views.columns,
            cutoff * cutoff * HALF_LOG2E, CHANNELS=channels, CONE=views.cone, BLOCK_H=BLOCK[0], BLOCK_W=BLOCK[1],
            RUN=_RUN, num_warps=1, num_stages=1,
        )  # fmt: skip
    return moments


@triton.jit
def _moment(at, live, k, factor):
    return tl.load(at + k, mask=live, other=0.0).to(tl.float64) * factor


@triton.jit
def _pull_back_kernel(
    position, scale, rotation, views, record, ellipse, moments,
    grad_position, grad_scale, grad_rotation, grad_weight, count, many,
    CHANNELS: tl.constexpr, CONE: tl.constexpr, PLANAR: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = n < count
    m00, m01, m02, m10, m11, m12, m20, m21, m22, _, _, _ = whitening(scale, rotation, n, live)
    none = tl.zeros([BLOCK], tl.float64)
    G00, G01, G02, G10, G11, G12, G20, G21, G22 = none, none, none, none, none, none, none, none, none
    P0, P1, P2 = none, none, none
    C0, C1, C2, C3 = none, none, none, none
    at, half_height, footprint, sums = views, ellipse + count + n, record + n * RECORD, moments + n * _MOMENTS
    for _ in range(many):
        seen = live & (tl.load(half_height, mask=live, other=-1.0) > 0)
        (_, kappa, column, row, r0, r1, r2, w0, w1, w2, a0, a1, a2, b0, b1, b2, nu0, nu1, nu2, nv0, nv1, nv2) = chain(
            position, n, live, at, m00, m01, m02, m10, m11, m12, m20, m21, m22, CONE
        )
        inverse = tl.load(footprint + 10, mask=seen, other=0.0).to(tl.float64)
        C0 += _moment(sums, seen, 11, inverse)
        if CHANNELS > 1:
            C1 += _moment(sums, seen, 12, inverse)
        if CHANNELS > 2:
            C2 += _moment(sums, seen, 13, inverse)
        if CHANNELS > 3:
            C3 += _moment(sums, seen, 14, inverse)
        # dL/d(distance^2 |e|^2) = -h / 2 and dL/d|e|^2 = -s / 2, here doubled: every use has a factor 2.
        unit = -inverse * inverse
        hx, hxx = _moment(sums, seen, 0, unit), _moment(sums, seen, 2, unit)
        hy, hxy, hyy = none, none, none
        sy, sxy, syy = none, none, none
        if not PLANAR:
            hy, hxy, hyy = _moment(sums, seen, 1, unit), _moment(sums, seen, 3, unit), _moment(sums, seen, 4, unit)
        s = _moment(sums, seen, 5, unit)
        e0, e1, e2 = kappa * w0, kappa * w1, kappa * w2
        nu_nu, nu_nv = dot(nu0, nu1, nu2, nu0, nu1, nu2), dot(nu0, nu1, nu2, nv0, nv1, nv2)
        # Gradients of nu, nv and of kappa w.
        gnu0, gnu1, gnu2 = nu0 * hxx + nv0 * hxy, nu1 * hxx + nv1 * hxy, nu2 * hxx + nv2 * hxy
        gnv0, gnv1, gnv2 = nu0 * hxy + nv0 * hyy, nu1 * hxy + nv1 * hyy, nu2 * hxy + nv2 * hyy
        ge0, ge1, ge2 = e0 * s, e1 * s, e2 * s
        g_column = -(nu_nu * hx + nu_nv * hy)
        g_row = -(nu_nv * hx + dot(nv0, nv1, nv2, nv0, nv1, nv2) * hy)
        ga0, ga1, ga2 = cross(gnu0, gnu1, gnu2, w0, w1, w2)
        gb0, gb1, gb2 = cross(gnv0, gnv1, gnv2, w0, w1, w2)
        if CONE:
            sx, sxx = _moment(sums, seen, 6, unit), _moment(sums, seen, 8, unit)
            if not PLANAR:
                sy, sxy = _moment(sums, seen, 7, unit), _moment(sums, seen, 9, unit)
                syy = _moment(sums, seen, 10, unit)
            ge0, ge1, ge2 = ge0 + a0 * sx + b0 * sy, ge1 + a1 * sx + b1 * sy, ge2 + a2 * sx + b2 * sy
            ga0 += e0 * sx + a0 * sxx + b0 * sxy
            ga1 += e1 * sx + a1 * sxx + b1 * sxy
            ga2 += e2 * sx + a2 * sxx + b2 * sxy
            gb0 += e0 * sy + a0 * sxy + b0 * syy
            gb1 += e1 * sy + a1 * sxy + b1 * syy
            gb2 += e2 * sy + a2 * sxy + b2 * syy
            ab = dot(a0, a1, a2, b0, b1, b2)
            g_column -= dot(e0, e1, e2, a0, a1, a2) * s + dot(a0, a1, a2, a0, a1, a2) * sx + ab * sy
            g_row -= dot(e0, e1, e2, b0, b1, b2) * s + ab * sx + dot(b0, b1, b2, b0, b1, b2) * sy
        if PLANAR:
            g_row = none
        # The adjoints of nu = w x WU and nv = w x WV.
        gw0, gw1, gw2 = cross(a0, a1, a2, gnu0, gnu1, gnu2)
        q0, q1, q2 = cross(b0, b1, b2, gnv0, gnv1, gnv2)
        gw0, gw1, gw2 = gw0 + q0 + kappa * ge0, gw1 + q1 + kappa * ge1, gw2 + q2 + kappa * ge2
        u0, u1, u2 = tl.load(at + 12), tl.load(at + 15), tl.load(at + 18)
        v0, v1, v2 = tl.load(at + 13), tl.load(at + 16), tl.load(at + 19)
        G00 += dot(gw0, ga0, gb0, r0, u0, v0)
        G01 += dot(gw0, ga0, gb0, r1, u1, v1)
        G02 += dot(gw0, ga0, gb0, r2, u2, v2)
        G10 += dot(gw1, ga1, gb1, r0, u0, v0)
        G11 += dot(gw1, ga1, gb1, r1, u1, v1)
        G12 += dot(gw1, ga1, gb1, r2, u2, v2)
        G20 += dot(gw2, ga2, gb2, r0, u0, v0)
        G21 += dot(gw2, ga2, gb2, r1, u1, v1)
        G22 += dot(gw2, ga2, gb2, r2, u2, v2)
        g_depth = none
        if CONE:
            P0 += dot(m00, m10, m20, gw0, gw1, gw2)
            P1 += dot(m01, m11, m21, gw0, gw1, gw2)
            P2 += dot(m02, m12, m22, gw0, gw1, gw2)
            g_depth = -kappa * (g_column * column + g_row * row + kappa * dot(ge0, ge1, ge2, w0, w1, w2))
        g_column, g_row = kappa * g_column, kappa * g_row
        P0 += dot(tl.load(at + 3), tl.load(at + 6), tl.load(at + 9), g_column, g_row, g_depth)
        P1 += dot(tl.load(at + 4), tl.load(at + 7), tl.load(at + 10), g_column, g_row, g_depth)
        P2 += dot(tl.load(at + 5), tl.load(at + 8), tl.load(at + 11), g_column, g_row, g_depth)
        at += VIEW
        half_height += 5 * count
        footprint += count * RECORD
        sums += count * _MOMENTS
    tl.store(grad_position + n * 3, P0.to(tl.float32), mask=live)
    tl.store(grad_position + n * 3 + 1, P1.to(tl.float32), mask=live)
    tl.store(grad_position + n * 3 + 2, P2.to(tl.float32), mask=live)
    tl.store(grad_weight + n, C0.to(tl.float32), mask=live)
    if CHANNELS > 1:
        tl.store(grad_weight + count + n, C1.to(tl.float32), mask=live)
    if CHANNELS > 2:
        tl.store(grad_weight + 2 * count + n, C2.to(tl.float32), mask=live)
    if CHANNELS > 3:
        tl.store(grad_weight + 3 * count + n, C3.to(tl.float32), mask=live)
    whitening_adjoint(
        scale, rotation, n, live, m00, m01, m02, m10, m11, m12, m20, m21, m22,
        G00, G01, G02, G10, G11, G12, G20, G21, G22, grad_scale, grad_rotation,
    )  # fmt: skip


def pull_back(position, scale, rotation, weight, table: torch.Tensor, views: DetectorViews, record, ellipse, moments):
    """Gradients of position, scale, rotation and weight from the moments, summed over the views."""
    grads = tuple(torch.empty_like(t) for t in (position, scale, rotation, weight))
    with on_device(position):
        _pull_back_kernel[(triton.cdiv(len(position), _GAUSSIANS),)](
            position, scale, rotation, table, record, ellipse, moments, *grads, len(position), len(views),
            CHANNELS=len(weight), CONE=views.cone, PLANAR=views.planar, BLOCK=_GAUSSIANS, num_warps=2,
        )  # fmt: skip
    return grads
