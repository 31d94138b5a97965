"""From sums over footprints to gradients, on CUDA: the adjoint of triton_setup.py, as README.md derives it.

One lane a Gaussian takes the moments of its footprints back to position, scale and rotation and adds up the
views.
"""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.project.triton_setup import ROOT, VIEW, chain, whitening
from tomo_polysplat.kernels.triton_lanes import SUMS, load_four
from tomo_polysplat.kernels.triton_maths import (
    SIZES,
    cross,
    dot,
    load_shape,
    load_three,
    on_device,
    whitening_adjoint,
)
from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["pull_back"]

_BLOCK = 64
# Of a lane, of one view and of several. All is read at the head, which holds registers: 200 000 Gaussians in one view
# take 16.4 us with 232 and 19.8 with 168. In several views more warps hide better what each waits for (194 000 in four:
# 66 us with 208, 58 with 168); with 128 it spills too much.
_REGISTERS = (232, 168)


@triton.jit
def _moments(live, m0, m1, m2, m3, a, b, c, d):
    """Four of the sums, in float64, each times its unit; zero where the Gaussian has no footprint."""
    return (
        tl.where(live, m0, 0.0).to(tl.float64) * a,
        tl.where(live, m1, 0.0).to(tl.float64) * b,
        tl.where(live, m2, 0.0).to(tl.float64) * c,
        tl.where(live, m3, 0.0).to(tl.float64) * d,
    )


@triton.jit
def _load_moments(at):
    m0, m1, m2, m3 = load_four(at)
    m4, m5, m6, m7 = load_four(at + 4)
    m8, m9, m10, m11 = load_four(at + 8)
    m12, m13, m14, m15 = load_four(at + 12)
    return m0, m1, m2, m3, m4, m5, m6, m7, m8, m9, m10, m11, m12, m13, m14, m15


@triton.jit
def _mix(a, x0, x1, x2, b, y0, y1, y2):
    return a * x0 + b * y0, a * x1 + b * y1, a * x2 + b * y2


@triton.jit
def _back(m00, m01, m02, m10, m11, m12, m20, m21, m22, x0, x1, x2):
    """W^T x."""
    return dot(m00, m10, m20, x0, x1, x2), dot(m01, m11, m21, x0, x1, x2), dot(m02, m12, m22, x0, x1, x2)


@triton.jit
def _add_up(to, x0, x1, x2, seen):
    """Store three sums over the Gaussians that are seen; of others there may be no number."""
    tl.store(to, tl.sum(tl.where(seen, x0, 0.0), 0))
    tl.store(to + 1, tl.sum(tl.where(seen, x1, 0.0), 0))
    tl.store(to + 2, tl.sum(tl.where(seen, x2, 0.0), 0))


@triton.jit(do_not_specialize=SIZES)
def _pull_back_kernel(
    position, scale, rotation, views, moments,
    grad_position, grad_scale, grad_rotation, grad_weight, grad_views, count, beyond, many,
    CHANNELS: tl.constexpr, CONE: tl.constexpr, PLANAR: tl.constexpr, OF_VIEWS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = n < count
    known = tl.minimum(n, count - 1)
    at, sums = views, moments + known * SUMS
    s0, s1, s2, qw, qx, qy, qz = load_shape(scale, rotation, known)
    p0, p1, p2 = load_three(position, known)
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = whitening(s0, s1, s2, qw, qx, qy, qz)
    none = tl.zeros([BLOCK], tl.float64)
    G00, G01, G02, G10, G11, G12, G20, G21, G22 = none, none, none, none, none, none, none, none, none
    P0, P1, P2 = none, none, none
    C0, C1, C2, C3 = none, none, none, none
    if OF_VIEWS:
        grad_views += tl.program_id(0).to(tl.int64) * many * 12
    for _view in range(many):
        k0, k1, k2, k3, k4, k5, k6, k7, k8, k9, k10, k11, c1, c2, c3, unit = _load_moments(sums)
        seen, inverse = live & (unit > 0), unit.to(tl.float64)
        (
            depth, kappa, column, row, r0, r1, r2, w0, w1, w2, a0, a1, a2, b0, b1, b2,
            nu0, nu1, nu2, nv0, nv1, nv2,
        ) = chain(p0, p1, p2, at, m00, m01, m02, m10, m11, m12, m20, m21, m22, CONE)  # fmt: skip
        # dL/d(distance^2 |e|^2) = -h / 2 and dL/d|e|^2 = -s / 2, here doubled: every use has a factor 2. The
        # sums take t and u ROOT / |e_centre| times too large.
        one, two, zero = -inverse * inverse, -inverse / ROOT, -1.0 / (ROOT * ROOT)
        ht, hu, htt, htu = _moments(seen, k0, k1, k2, k3, two, two, zero, zero)
        huu, s, st, su = _moments(seen, k4, k5, k6, k7, zero, one, two, two)
        stt, stu, suu, c0 = _moments(seen, k8, k9, k10, k11, zero, zero, zero, inverse)
        own = tl.where(seen, inverse, 0.0)
        C0, C1, C2, C3 = C0 + c0, C1 + c1 * own, C2 + c2 * own, C3 + c3 * own
        # nu = r11 q1 and nv = r12 q1 + r22 q2, so x = by_t t - back u and y = by_u u.
        by_t = tl.math.rsqrt(tl.where(seen, dot(nu0, nu1, nu2, nu0, nu1, nu2), 1.0))
        q10, q11, q12 = by_t * nu0, by_t * nu1, by_t * nu2
        r12 = dot(q10, q11, q12, nv0, nv1, nv2)
        q20, q21, q22 = nv0 - r12 * q10, nv1 - r12 * q11, nv2 - r12 * q12
        square = dot(q20, q21, q22, q20, q21, q22)
        by_u = none
        if not PLANAR:
            by_u = tl.where(seen & (square > 0), tl.math.rsqrt(tl.where(square > 0, square, 1.0)), 0.0)
        r22 = square * by_u
        q20, q21, q22 = by_u * q20, by_u * q21, by_u * q22
        back = by_t * r12 * by_u
        t0, t1, t2 = _mix(htt, q10, q11, q12, htu, q20, q21, q22)
        u0, u1, u2 = _mix(htu, q10, q11, q12, huu, q20, q21, q22)
        gnu0, gnu1, gnu2 = _mix(by_t, t0, t1, t2, -back, u0, u1, u2)
        gnv0, gnv1, gnv2 = by_u * u0, by_u * u1, by_u * u2
        g_column, g_row = -ht / by_t, -(r12 * ht + r22 * hu)
        # The adjoints of nu = w x WU and nv = w x WV.
        ga0, ga1, ga2 = cross(gnu0, gnu1, gnu2, w0, w1, w2)
        gb0, gb1, gb2 = cross(gnv0, gnv1, gnv2, w0, w1, w2)
        gw0, gw1, gw2 = cross(a0, a1, a2, gnu0, gnu1, gnu2)
        t0, t1, t2 = cross(b0, b1, b2, gnv0, gnv1, gnv2)
        gw0, gw1, gw2 = gw0 + t0, gw1 + t1, gw2 + t2
        if CONE:
            # e = e0 + t et + u eu.
            e0, e1, e2 = kappa * w0, kappa * w1, kappa * w2
            t0, t1, t2 = by_t * a0, by_t * a1, by_t * a2
            u0, u1, u2 = _mix(by_u, b0, b1, b2, -back, a0, a1, a2)
            ge0, ge1, ge2 = s * e0 + st * t0 + su * u0, s * e1 + st * t1 + su * u1, s * e2 + st * t2 + su * u2
            along0, along1 = st * e0 + stt * t0 + stu * u0, st * e1 + stt * t1 + stu * u1
            along2 = st * e2 + stt * t2 + stu * u2
            up0, up1 = su * e0 + stu * t0 + suu * u0, su * e1 + stu * t1 + suu * u1
            up2 = su * e2 + stu * t2 + suu * u2
            t0, t1, t2 = _mix(by_t, along0, along1, along2, -back, up0, up1, up2)
            ga0, ga1, ga2 = ga0 + t0, ga1 + t1, ga2 + t2
            gb0, gb1, gb2 = gb0 + by_u * up0, gb1 + by_u * up1, gb2 + by_u * up2
            gw0, gw1, gw2 = gw0 + kappa * ge0, gw1 + kappa * ge1, gw2 + kappa * ge2
            g_column -= dot(ge0, ge1, ge2, a0, a1, a2)
            g_row -= dot(ge0, ge1, ge2, b0, b1, b2)
        else:
            gw0, gw1, gw2 = gw0 + s * w0, gw1 + s * w1, gw2 + s * w2
        if PLANAR:
            g_row = none
        U0, U1, U2 = tl.load(at + 12), tl.load(at + 15), tl.load(at + 18)
        V0, V1, V2 = tl.load(at + 13), tl.load(at + 16), tl.load(at + 19)
        G00 += dot(gw0, ga0, gb0, r0, U0, V0)
        G01 += dot(gw0, ga0, gb0, r1, U1, V1)
        G02 += dot(gw0, ga0, gb0, r2, U2, V2)
        G10 += dot(gw1, ga1, gb1, r0, U0, V0)
        G11 += dot(gw1, ga1, gb1, r1, U1, V1)
        G12 += dot(gw1, ga1, gb1, r2, U2, V2)
        G20 += dot(gw2, ga2, gb2, r0, U0, V0)
        G21 += dot(gw2, ga2, gb2, r1, U1, V1)
        G22 += dot(gw2, ga2, gb2, r2, U2, V2)
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
        if OF_VIEWS:
            # The offset of the Gaussian is (a, b, c) under the inverse, and (g_column, g_row, g_depth) is t under its
            # transpose: the inverse's part of dL/d(U, V, D) is -(a, b, c) t.
            t0 = dot(tl.load(at + 3), tl.load(at + 6), tl.load(at + 9), g_column, g_row, g_depth)
            t1 = dot(tl.load(at + 4), tl.load(at + 7), tl.load(at + 10), g_column, g_row, g_depth)
            t2 = dot(tl.load(at + 5), tl.load(at + 8), tl.load(at + 11), g_column, g_row, g_depth)
            a, b = column / kappa, row / kappa
            e0, e1, e2 = _back(m00, m01, m02, m10, m11, m12, m20, m21, m22, gw0, gw1, gw2)
            if CONE:
                _add_up(grad_views, -t0 - e0, -t1 - e1, -t2 - e2, seen)
                _add_up(grad_views + 9, -depth * t0, -depth * t1, -depth * t2, seen)
            else:
                _add_up(grad_views, -t0, -t1, -t2, seen)
                _add_up(grad_views + 9, e0 - depth * t0, e1 - depth * t1, e2 - depth * t2, seen)
            e0, e1, e2 = _back(m00, m01, m02, m10, m11, m12, m20, m21, m22, ga0, ga1, ga2)
            _add_up(grad_views + 3, e0 - a * t0, e1 - a * t1, e2 - a * t2, seen)
            e0, e1, e2 = _back(m00, m01, m02, m10, m11, m12, m20, m21, m22, gb0, gb1, gb2)
            _add_up(grad_views + 6, e0 - b * t0, e1 - b * t1, e2 - b * t2, seen)
            grad_views += 12
        at += VIEW
        sums += tl.cast(beyond, tl.int64) * SUMS
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
        s0, s1, s2, qw, qx, qy, qz, n, live, m00, m01, m02, m10, m11, m12, m20, m21, m22,
        G00, G01, G02, G10, G11, G12, G20, G21, G22, grad_scale, grad_rotation,
    )  # fmt: skip


def pull_back(
    position,
    scale,
    rotation,
    weight,
    table: torch.Tensor,
    views: DetectorViews,
    moments,
    *,
    of_views: bool = False,
) -> tuple[torch.Tensor, ...]:
    """Gradients of position, scale, rotation and weight from the moments, summed over the views.

    With ``of_views`` that of ``views.vectors`` comes fifth, (views, 4, 3) float64, without what the length of the
    pixels' rays adds (`tomo_polysplat.kernels.views.length_gradient`).
    """
    grads = tuple(torch.empty_like(t) for t in (position, scale, rotation, weight))
    programs = triton.cdiv(len(position), _BLOCK)
    shape = (programs, len(views), 12) if of_views else (0,)
    by_program = torch.empty(shape, dtype=torch.float64, device=position.device)
    with on_device(position):
        _pull_back_kernel[(programs,)](
            position, scale, rotation, table, moments, *grads, by_program,
            len(position), moments.shape[1], len(views),
            CHANNELS=len(weight), CONE=views.cone, PLANAR=views.planar, OF_VIEWS=of_views, BLOCK=_BLOCK,
            num_warps=2, maxnreg=255 if of_views else _REGISTERS[len(views) > 1],
        )  # fmt: skip
    return (*grads, by_program.sum(dim=0).reshape(-1, 4, 3)) if of_views else grads
