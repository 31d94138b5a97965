"""From sums over footprints to gradients, on CUDA: the adjoint of triton_setup.py, as README.md derives it.

One lane a Gaussian takes the moments of its footprints back to position, scale and rotation and adds up the
views.
"""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.project.triton_backward import MOMENTS
from tomo_polysplat.kernels.project.triton_setup import RECORD, VIEW, chain, whitening
from tomo_polysplat.kernels.triton_maths import cross, dot, on_device, whitening_adjoint
from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["pull_back"]

_BLOCK = 64


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
    at, half_height, footprint, sums = views, ellipse + count + n, record + n * RECORD, moments + n * MOMENTS
    for _ in range(many):
        seen = live & (tl.load(half_height, mask=live, other=-1.0) > 0)
        (
            _, kappa, column, row, r0, r1, r2, w0, w1, w2, a0, a1, a2, b0, b1, b2,
            nu0, nu1, nu2, nv0, nv1, nv2,
        ) = chain(position, n, live, at, m00, m01, m02, m10, m11, m12, m20, m21, m22, CONE)  # fmt: skip
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
            hy, hxy = _moment(sums, seen, 1, unit), _moment(sums, seen, 3, unit)
            hyy = _moment(sums, seen, 4, unit)
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
        sums += count * MOMENTS
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


def pull_back(
    position, scale, rotation, weight, table: torch.Tensor, views: DetectorViews, record, ellipse, moments
) -> tuple[torch.Tensor, ...]:
    """Gradients of position, scale, rotation and weight from the moments, summed over the views."""
    grads = tuple(torch.empty_like(t) for t in (position, scale, rotation, weight))
    with on_device(position):
        _pull_back_kernel[(triton.cdiv(len(position), _BLOCK),)](
            position, scale, rotation, table, record, ellipse, moments, *grads, len(position), len(views),
            CHANNELS=len(weight), CONE=views.cone, PLANAR=views.planar, BLOCK=_BLOCK, num_warps=2,
        )  # fmt: skip
    return grads
