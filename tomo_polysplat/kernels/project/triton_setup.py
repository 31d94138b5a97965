"""Footprints: what the Triton kernels need of a Gaussian in a view, computed once.

README.md has the formulas.

``record`` (views, count, 16) holds for one Gaussian at a time, with x and y counted from the projected centre

* 0, 1: column and row of the projected centre;
* 2-4: r11, r12, r22 with q = ((r11 x + r12 y)^2 + (r22 y)^2) / l, the squared distance times HALF_LOG2E;
* 5-9: l = 1 + x (l5 + l7 x + l8 y) + y (l6 + l9 y) = |e|^2 / |e_centre|^2 (one for parallel rays);
* 10: 1 / |e_centre|;
* 11-14: the weights, times 1 / |e_centre|.

``ellipse`` (views, 5, count) holds the outline where the Gaussian is cut, for many Gaussians at a time: row
yc and half-height ry, column xc, slope m and half-width hx with
|column - xc - m (row - yc)| <= hx sqrt(1 - ((row - yc) / ry)^2); ry = -1 where there is none. ``boxes``
(views, 4, groups) are the bounding boxes, columns then rows, of GROUP neighbours in the list.
"""

from __future__ import annotations

import numpy as np
import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.triton_maths import GROUP, HALF_LOG2E, cross, dot, on_device, rotation_matrix
from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["RECORD", "VIEW", "chain", "footprints", "view_table", "whitening"]

RECORD = tl.constexpr(16)
VIEW = tl.constexpr(21)  # origin, inverse and matrix of a view, row by row
_ROOT = tl.constexpr(HALF_LOG2E**0.5)
_FAR = tl.constexpr(1e30)
_SLACK = tl.constexpr(0.01)  # of a pixel, on the outline: rounding must not cut what q still includes
_BLOCK = 128


def view_table(views: DetectorViews, device: torch.device) -> torch.Tensor:
    """(views, 21) float64 origin, inverse and matrix."""
    count = len(views)
    parts = [views.origin, views.inverse.reshape(count, 9), views.matrix.reshape(count, 9)]
    # From ordinary memory the copy is staged at once: it neither waits for the device nor races with numpy.
    return torch.from_numpy(np.concatenate(parts, axis=1)).to(device, non_blocking=True)


@triton.jit
def whitening(scale, rotation, n, live):
    """``W = diag(1/scale) R^T`` row by row, then scale, in float64."""
    w00, w01, w02, w10, w11, w12, w20, w21, w22 = rotation_matrix(rotation, n, live)
    s0 = tl.load(scale + n * 3, mask=live, other=1.0).to(tl.float64)
    s1 = tl.load(scale + n * 3 + 1, mask=live, other=1.0).to(tl.float64)
    s2 = tl.load(scale + n * 3 + 2, mask=live, other=1.0).to(tl.float64)
    return (
        w00 / s0, w01 / s0, w02 / s0, w10 / s1, w11 / s1, w12 / s1, w20 / s2, w21 / s2, w22 / s2, s0, s1, s2,
    )  # fmt: skip


@triton.jit
def _apply(w00, w01, w02, w10, w11, w12, w20, w21, w22, x, y, z):
    return dot(w00, w01, w02, x, y, z), dot(w10, w11, w12, x, y, z), dot(w20, w21, w22, x, y, z)


@triton.jit
def chain(position, n, live, view, w00, w01, w02, w10, w11, w12, w20, w21, w22, CONE: tl.constexpr):
    """Depth c, kappa, column0, row0 and the vectors r, w = W r, WU, WV, nu = w x WU, nv = w x WV in float64.

    r runs from the source to the Gaussian, or is the direction of parallel rays.
    """
    r0 = tl.load(position + n * 3, mask=live, other=0.0).to(tl.float64) - tl.load(view)
    r1 = tl.load(position + n * 3 + 1, mask=live, other=0.0).to(tl.float64) - tl.load(view + 1)
    r2 = tl.load(position + n * 3 + 2, mask=live, other=0.0).to(tl.float64) - tl.load(view + 2)
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
    turned = tl.where(turned != 0, turned * s * s, 0.0)
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
    if PLANAR:
        valid = (a > 0) & (rest > 0)
        safe = tl.where(valid, a, 1.0)
        none = tl.zeros_like(a)
        return none, none + 1, -b0 / safe, none, tl.sqrt(tl.where(valid, rest, 1.0)) / safe, valid
    lead, half = b1 * b1 - a * c2, b0 * b1 - 0.5 * a * c1
    inside = half * half - lead * rest
    valid = (a > 0) & (lead < 0) & (inside > 0)
    a, lead, inside = tl.where(valid, a, 1.0), tl.where(valid, lead, -1.0), tl.where(valid, inside, 1.0)
    yc, ry = -half / lead, tl.sqrt(inside) / -lead
    # rest - half^2 / lead, the parabola's top, without its cancellation.
    hx = tl.sqrt(inside / -lead) / a
    return yc, ry, -(b0 + b1 * yc) / a, -b1 / a, hx, valid


@triton.jit
def _store_outline(ellipse, boxes, view, n, live, count, groups, yc, ry, xc, m, hx, valid, BLOCK, GROUP):
    ry = tl.where(valid, ry + _SLACK, -1.0)
    hx += _SLACK
    out = ellipse + view * 5 * count + n
    tl.store(out, yc.to(tl.float32), mask=live)
    tl.store(out + count, ry.to(tl.float32), mask=live)
    tl.store(out + 2 * count, xc.to(tl.float32), mask=live)
    tl.store(out + 3 * count, m.to(tl.float32), mask=live)
    tl.store(out + 4 * count, hx.to(tl.float32), mask=live)
    reach = tl.sqrt(m * m * ry * ry + hx * hx)
    low_x, high_x = tl.where(valid, xc - reach, _FAR), tl.where(valid, xc + reach, -_FAR)
    low_y, high_y = tl.where(valid, yc - ry, _FAR), tl.where(valid, yc + ry, -_FAR)
    g = tl.program_id(0) * (BLOCK // GROUP) + tl.arange(0, BLOCK // GROUP)
    box = boxes + view * 4 * groups + g
    shape: tl.constexpr = [BLOCK // GROUP, GROUP]
    tl.store(box, tl.min(tl.reshape(low_x, shape), 1).to(tl.float32), mask=g < groups)
    tl.store(box + groups, tl.max(tl.reshape(high_x, shape), 1).to(tl.float32), mask=g < groups)
    tl.store(box + 2 * groups, tl.min(tl.reshape(low_y, shape), 1).to(tl.float32), mask=g < groups)
    tl.store(box + 3 * groups, tl.max(tl.reshape(high_y, shape), 1).to(tl.float32), mask=g < groups)


@triton.jit
def _footprint_kernel(
    position, scale, rotation, weight, views, record, ellipse, boxes, skipped, count, groups, cutoff,
    CHANNELS: tl.constexpr, CONE: tl.constexpr, PLANAR: tl.constexpr, BLOCK: tl.constexpr,
    GROUP: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    view = tl.program_id(1).to(tl.int64)
    live = n < count
    at = views + view * VIEW
    w00, w01, w02, w10, w11, w12, w20, w21, w22, s0, s1, s2 = whitening(scale, rotation, n, live)
    (
        depth, kappa, column, row, r0, r1, r2, w0, w1, w2, a0, a1, a2, b0, b1, b2,
        nu0, nu1, nu2, nv0, nv1, nv2,
    ) = chain(position, n, live, at, w00, w01, w02, w10, w11, w12, w20, w21, w22, CONE)  # fmt: skip
    valid = live
    if CONE:
        # The cut Gaussian must lie in front of the source plane: its half-width in depth is |S R^T c_row|.
        c0, c1, c2 = tl.load(at + 9), tl.load(at + 10), tl.load(at + 11)
        reach = _turned(w00, w01, w02, c0, c1, c2, s0) + _turned(w10, w11, w12, c0, c1, c2, s1)
        reach += _turned(w20, w21, w22, c0, c1, c2, s2)
        valid = live & (depth > 1.001 * cutoff * tl.sqrt(reach))
        tl.atomic_add(skipped, tl.sum((live & ~valid).to(tl.int64), 0), sem="relaxed")
    # In units of |e_centre|, so that l is one at the centre.
    inverse = 1.0 / (kappa * tl.sqrt(dot(w0, w1, w2, w0, w1, w2)))
    square = inverse * inverse
    uu = dot(nu0, nu1, nu2, nu0, nu1, nu2)
    valid &= uu > 0
    r11 = tl.sqrt(uu)
    safe = tl.where(valid, r11, 1.0)
    n0, n1, n2 = cross(nu0, nu1, nu2, nv0, nv1, nv2)
    r12 = dot(nu0, nu1, nu2, nv0, nv1, nv2) / safe * inverse
    r22 = tl.sqrt(dot(n0, n1, n2, n0, n1, n2)) / safe * inverse
    r11 *= inverse
    zero = tl.zeros_like(r11)
    lx, ly, lxx, lxy, lyy = zero, zero, zero, zero, zero
    if CONE:
        lx, ly = dot(w0, w1, w2, a0, a1, a2) * kappa * square, dot(w0, w1, w2, b0, b1, b2) * kappa * square
        lxx, lxy = dot(a0, a1, a2, a0, a1, a2) * square, dot(a0, a1, a2, b0, b1, b2) * square
        lyy = dot(b0, b1, b2, b0, b1, b2) * square
    if PLANAR:
        row = zero
    cut = cutoff * cutoff
    yc, ry, xc, m, hx, outlined = _outline(cut, r11, r12, r22, 1.0, lx, ly, lxx, lxy, lyy, PLANAR)
    valid &= outlined
    _store_outline(
        ellipse, boxes, view, n, live, count, groups, yc + row, ry, xc + column, m, hx, valid, BLOCK, GROUP
    )
    out = record + (view * count + n) * RECORD
    tl.store(out, column.to(tl.float32), mask=live)
    tl.store(out + 1, row.to(tl.float32), mask=live)
    tl.store(out + 2, (r11 * _ROOT).to(tl.float32), mask=live)
    tl.store(out + 3, (r12 * _ROOT).to(tl.float32), mask=live)
    tl.store(out + 4, (r22 * _ROOT).to(tl.float32), mask=live)
    if CONE:
        tl.store(out + 5, (2 * lx).to(tl.float32), mask=live)
        tl.store(out + 6, (2 * ly).to(tl.float32), mask=live)
        tl.store(out + 7, lxx.to(tl.float32), mask=live)
        tl.store(out + 8, (2 * lxy).to(tl.float32), mask=live)
        tl.store(out + 9, lyy.to(tl.float32), mask=live)
    tl.store(out + 10, inverse.to(tl.float32), mask=live)
    for k in tl.static_range(CHANNELS):
        height = tl.load(weight + k * count + n, mask=live, other=0.0)
        tl.store(out + 11 + k, (height * inverse).to(tl.float32), mask=live)


def footprints(position, scale, rotation, weight, views: DetectorViews, table: torch.Tensor, cutoff: float):
    """``record``, ``ellipse``, ``boxes`` of the module docstring; number of skipped pairs, 0-dim int64."""
    count, groups, many = len(position), triton.cdiv(len(position), GROUP), len(views)
    record = position.new_empty((many, count, RECORD.value))
    ellipse = position.new_empty((many, 5, count))
    boxes = position.new_empty((many, 4, groups))
    skipped = torch.zeros((), dtype=torch.int64, device=position.device)
    if count and many:
        with on_device(position):
            _footprint_kernel[(triton.cdiv(count, _BLOCK), many)](
                position, scale, rotation, weight, table, record, ellipse, boxes, skipped, count, groups,
                cutoff, CHANNELS=len(weight), CONE=views.cone, PLANAR=views.planar, BLOCK=_BLOCK, GROUP=GROUP,
                num_warps=4,
            )  # fmt: skip
    return record, ellipse, boxes, skipped
