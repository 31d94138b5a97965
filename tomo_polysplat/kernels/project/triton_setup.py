"""Footprints: what the Triton kernels need of a Gaussian in a view, computed once.

README.md has the formulas.

``record`` (views, groups, 5, GROUP, 4), of an even number of groups, holds the twenty numbers below by fours, those of
neighbours in the list side by side; after the last Gaussian come some that miss the detector. With x and y counted from
the projected centre:

* 0, 1: column and row of the projected centre;
* 2-4: r11, r12, r22 of t = r11 x + r12 y and u = r22 y; q = (t^2 + u^2) / l is the squared distance times HALF_LOG2E;
* 5-9: l = 1 + t (l5 + l7 t + l8 u) + u (l6 + l9 u) = |e|^2 / |e_centre|^2 (one for parallel rays);
* 10-13: the weights, times 1 / |e_centre|, which is
* 14: itself;
* 15-19: the outline where the Gaussian is cut, as half-width hx, row yc and half-height ry, column xc and slope m
  with |column - xc - m (row - yc)| <= hx sqrt(1 - ((row - yc) / ry)^2); ry = -1 if it misses the detector.

Sums over pixels need the first thirteen to fifteen, four loads of four.
"""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.triton_lanes import store_four
from tomo_polysplat.kernels.triton_maths import (
    GROUP,
    HALF_LOG2E,
    SIZES,
    cross,
    dot,
    load_shape,
    load_three,
    on_device,
    rotation_matrix,
)
from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["QUAD", "RECORD", "ROOT", "SLACK", "VIEW", "chain", "footprints", "whitening"]

RECORD = tl.constexpr(20)
QUAD = tl.constexpr(4 * GROUP)  # from four numbers of a Gaussian to its next four
VIEW = tl.constexpr(21)  # origin, inverse and matrix of a view, row by row
ROOT = tl.constexpr(HALF_LOG2E**0.5)
SLACK = tl.constexpr(0.01)  # of a pixel, on the outline: rounding must not cut what q still includes


@triton.jit
def whitening(s0, s1, s2, w, x, y, z):
    """``W = diag(1/scale) R^T`` row by row, in float64."""
    w00, w01, w02, w10, w11, w12, w20, w21, w22 = rotation_matrix(w, x, y, z)
    a, b, c = 1.0 / s0.to(tl.float64), 1.0 / s1.to(tl.float64), 1.0 / s2.to(tl.float64)
    return w00 * a, w01 * a, w02 * a, w10 * b, w11 * b, w12 * b, w20 * c, w21 * c, w22 * c


@triton.jit
def _apply(w00, w01, w02, w10, w11, w12, w20, w21, w22, x, y, z):
    return dot(w00, w01, w02, x, y, z), dot(w10, w11, w12, x, y, z), dot(w20, w21, w22, x, y, z)


@triton.jit
def chain(p0, p1, p2, view, w00, w01, w02, w10, w11, w12, w20, w21, w22, CONE: tl.constexpr):
    """Depth c, kappa, column0, row0 and the vectors r, w = W r, WU, WV, nu = w x WU, nv = w x WV in float64.

    r runs from the source to the Gaussian, or is the direction of parallel rays.
    """
    r0 = p0.to(tl.float64) - tl.load(view)
    r1 = p1.to(tl.float64) - tl.load(view + 1)
    r2 = p2.to(tl.float64) - tl.load(view + 2)
    column = dot(tl.load(view + 3), tl.load(view + 4), tl.load(view + 5), r0, r1, r2)
    row = dot(tl.load(view + 6), tl.load(view + 7), tl.load(view + 8), r0, r1, r2)
    depth = dot(tl.load(view + 9), tl.load(view + 10), tl.load(view + 11), r0, r1, r2)
    if CONE:
        kappa = 1.0 / tl.where(depth > 0, depth, 1.0)
        column *= kappa
        row *= kappa
    else:
        kappa = tl.full(depth.shape, 1.0, tl.float64)
        r0 = kappa * tl.load(view + 14)
        r1 = kappa * tl.load(view + 17)
        r2 = kappa * tl.load(view + 20)
    u0, u1, u2 = tl.load(view + 12), tl.load(view + 15), tl.load(view + 18)
    v0, v1, v2 = tl.load(view + 13), tl.load(view + 16), tl.load(view + 19)
    w0, w1, w2 = _apply(w00, w01, w02, w10, w11, w12, w20, w21, w22, r0, r1, r2)
    a0, a1, a2 = _apply(w00, w01, w02, w10, w11, w12, w20, w21, w22, u0, u1, u2)
    b0, b1, b2 = _apply(w00, w01, w02, w10, w11, w12, w20, w21, w22, v0, v1, v2)
    nu0, nu1, nu2 = cross(w0, w1, w2, a0, a1, a2)
    nv0, nv1, nv2 = cross(w0, w1, w2, b0, b1, b2)
    return (
        depth, kappa, column, row, r0, r1, r2, w0, w1, w2, a0, a1, a2, b0, b1, b2,
        nu0, nu1, nu2, nv0, nv1, nv2,
    )  # fmt: skip


@triton.jit
def _turned(w0, w1, w2, c0, c1, c2, s):
    """Square of one component of S R^T c; zero, not NaN, where an infinite scale does not see c."""
    turned = dot(w0, w1, w2, c0, c1, c2)
    turned = tl.where(turned != 0, turned * s.to(tl.float64) * s, 0.0)
    return turned * turned


@triton.jit
def _outline(cut, r11, r12, r22, lc, lx, ly, lxx, lxy, lyy, PLANAR: tl.constexpr):
    """yc, ry, xc, m, hx relative to the projected centre, and where they exist.

    Along a row the cut is where a x^2 + 2 b x + c = 0 with b linear and c quadratic in y, so its middle is
    linear in y and the square of its half-width is a parabola.
    """
    a = r11 * r11 - cut * lxx
    b0, b1 = -cut * lx, r11 * r12 - cut * lxy
    c0, c1, c2 = -cut * lc, -2 * cut * ly, r12 * r12 + r22 * r22 - cut * lyy
    rest = b0 * b0 - a * c0
    by_a = 1.0 / tl.where(a > 0, a, 1.0)
    if PLANAR:
        valid = (a > 0) & (rest > 0)
        none = tl.zeros_like(a)
        return none, none + 1, -b0 * by_a, none, tl.sqrt(tl.where(valid, rest, 1.0)) * by_a, valid
    lead, half = b1 * b1 - a * c2, b0 * b1 - 0.5 * a * c1
    inside = half * half - lead * rest
    valid = (a > 0) & (lead < 0) & (inside > 0)
    by_lead, inside = -1.0 / tl.where(valid, lead, -1.0), tl.where(valid, inside, 1.0)
    yc, ry = half * by_lead, tl.sqrt(inside) * by_lead
    # rest - half^2 / lead, the parabola's top, without its cancellation.
    hx = tl.sqrt(inside * by_lead) * by_a
    return yc, ry, -(b0 + b1 * yc) * by_a, -b1 * by_a, hx, valid


@triton.jit
def _store(at, a, b, c, d, every):
    store_four(at, a.to(tl.float32), b.to(tl.float32), c.to(tl.float32), d.to(tl.float32), every)


@triton.jit
def _weight(weight, n, count, k, CHANNELS: tl.constexpr):
    if k < CHANNELS:
        return tl.load(weight + k * count + n)
    return tl.zeros(n.shape, tl.float32)


@triton.jit(do_not_specialize=SIZES)
def _footprint_kernel(
    position, scale, rotation, weight, views, record, skipped, count, rows, columns, cutoff,
    CHANNELS: tl.constexpr, CONE: tl.constexpr, PLANAR: tl.constexpr, GROUP: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * GROUP + tl.arange(0, GROUP)
    view = tl.program_id(1).to(tl.int64)
    live = n < count
    known = tl.minimum(n, count - 1)
    s0, s1, s2, qw, qx, qy, qz = load_shape(scale, rotation, known)
    p0, p1, p2 = load_three(position, known)
    c0, c1 = _weight(weight, known, count, 0, CHANNELS), _weight(weight, known, count, 1, CHANNELS)
    c2, c3 = _weight(weight, known, count, 2, CHANNELS), _weight(weight, known, count, 3, CHANNELS)
    at = views + view * VIEW
    w00, w01, w02, w10, w11, w12, w20, w21, w22 = whitening(s0, s1, s2, qw, qx, qy, qz)
    (
        depth, kappa, column, row, r0, r1, r2, w0, w1, w2, a0, a1, a2, b0, b1, b2,
        nu0, nu1, nu2, nv0, nv1, nv2,
    ) = chain(p0, p1, p2, at, w00, w01, w02, w10, w11, w12, w20, w21, w22, CONE)  # fmt: skip
    valid = live
    if CONE:
        # The cut Gaussian must lie in front of the source plane: its half-width in depth is |S R^T c_row|.
        i0, i1, i2 = tl.load(at + 9), tl.load(at + 10), tl.load(at + 11)
        reach = _turned(w00, w01, w02, i0, i1, i2, s0) + _turned(w10, w11, w12, i0, i1, i2, s1)
        reach += _turned(w20, w21, w22, i0, i1, i2, s2)
        valid = live & (depth > 1.001 * cutoff * tl.sqrt(reach))
        behind = tl.sum((live & ~valid).to(tl.int64), 0)
        # Additions to one place wait for each other, and nearly all would add nothing.
        tl.atomic_add(skipped, behind, mask=behind > 0, sem="relaxed")
    # In units of |e_centre|, so that l is one at the centre.
    inverse = tl.math.rsqrt(kappa * kappa * dot(w0, w1, w2, w0, w1, w2))
    square = inverse * inverse
    uu = dot(nu0, nu1, nu2, nu0, nu1, nu2)
    valid &= uu > 0
    by_u = tl.math.rsqrt(tl.where(valid, uu, 1.0))
    n0, n1, n2 = cross(nu0, nu1, nu2, nv0, nv1, nv2)
    r11 = uu * by_u * inverse
    r12 = dot(nu0, nu1, nu2, nv0, nv1, nv2) * by_u * inverse
    r22 = tl.sqrt(dot(n0, n1, n2, n0, n1, n2)) * by_u * inverse
    zero = tl.zeros_like(r11)
    lx, ly, lxx, lxy, lyy = zero, zero, zero, zero, zero
    lt, lu, ltt, ltu, luu = zero, zero, zero, zero, zero
    if CONE:
        lx, ly = dot(w0, w1, w2, a0, a1, a2) * kappa * square, dot(w0, w1, w2, b0, b1, b2) * kappa * square
        lxx, lxy = dot(a0, a1, a2, a0, a1, a2) * square, dot(a0, a1, a2, b0, b1, b2) * square
        lyy = dot(b0, b1, b2, b0, b1, b2) * square
        # e = e_centre + t (a / r11) + u (b / r22 - a r12 / (r11 r22)), in the records' scale.
        by_t = 1.0 / (ROOT * tl.where(r11 > 0, r11, 1.0))
        by_u = tl.where(r22 > 0, 1.0 / (ROOT * tl.where(r22 > 0, r22, 1.0)), 0.0)
        back = by_t * (ROOT * r12) * by_u
        t0, t1, t2 = by_t * a0, by_t * a1, by_t * a2
        u0, u1, u2 = by_u * b0 - back * a0, by_u * b1 - back * a1, by_u * b2 - back * a2
        lt, lu = dot(w0, w1, w2, t0, t1, t2) * kappa * square, dot(w0, w1, w2, u0, u1, u2) * kappa * square
        ltt, ltu = dot(t0, t1, t2, t0, t1, t2) * square, dot(t0, t1, t2, u0, u1, u2) * square
        luu = dot(u0, u1, u2, u0, u1, u2) * square
    if PLANAR:
        row = zero
    cut = cutoff * cutoff
    yc, ry, xc, m, hx, outlined = _outline(cut, r11, r12, r22, 1.0, lx, ly, lxx, lxy, lyy, PLANAR)
    yc, ry, xc, hx = yc + row, ry + SLACK, xc + column, hx + SLACK
    reach = tl.sqrt(m * m * ry * ry + hx * hx)
    valid &= (
        outlined & (yc + ry >= 0) & (yc - ry <= rows - 1) & (xc + reach >= 0) & (xc - reach <= columns - 1)
    )
    ry = tl.where(valid, ry, -1.0)
    to = record + (view * tl.num_programs(0) + tl.program_id(0)) * (GROUP * RECORD) + 4 * tl.arange(0, GROUP)
    every = n >= 0
    _store(to, column, row, r11 * ROOT, r12 * ROOT, every)
    _store(to + QUAD, r22 * ROOT, 2 * lt, 2 * lu, ltt, every)
    _store(to + 2 * QUAD, 2 * ltu, luu, c0 * inverse, c1 * inverse, every)
    _store(to + 3 * QUAD, c2 * inverse, c3 * inverse, inverse, hx, every)
    _store(to + 4 * QUAD, yc, ry, xc, m, every)


def footprints(
    position,
    scale,
    rotation,
    weight,
    views: DetectorViews,
    table: torch.Tensor,
    cutoff: float,
    skipped: torch.Tensor,
) -> torch.Tensor:
    """``record`` of the module docstring; the number of skipped pairs is added to ``skipped``, 0-dim int64."""
    count, many = len(position), len(views)
    groups = 2 * triton.cdiv(count, 2 * GROUP)  # the adjoint takes two together
    record = position.new_empty((many, groups, RECORD.value // 4, GROUP, 4))
    if count and many:
        with on_device(position):
            _footprint_kernel[(groups, many)](
                position, scale, rotation, weight, table, record, skipped, count, views.rows, views.columns,
                cutoff, CHANNELS=len(weight), CONE=views.cone, PLANAR=views.planar, GROUP=GROUP, num_warps=1,
            )  # fmt: skip
    return record
