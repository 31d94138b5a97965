"""The adjoint of the projection on CUDA: every Gaussian gathers the gradients of its pixels, without atomics.

Four lanes sum over the pixels of a Gaussian in a view; triton_pull_back.py goes on from these sums.
"""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.project.triton_image import spread
from tomo_polysplat.kernels.project.triton_setup import RECORD, SLACK
from tomo_polysplat.kernels.triton_lanes import SUMS, load_four, store_sums
from tomo_polysplat.kernels.triton_maths import HALF_LOG2E, SIZES, on_device
from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["BLOCK", "beyond", "sum_moments"]

BLOCK = (2, 2)  # rows and columns of the four lanes that walk along the rows of a footprint
_PLANAR_BLOCK = (1, 4)
_RUN = 2  # times eight neighbours handled by one warp: more programs cost more to start than to run
_TINY = tl.constexpr(1e-20)
_TWO_LN2 = tl.constexpr(1 / HALF_LOG2E)


@triton.jit
def _row_ends(offset, known, by_ry, ry, xc, m, hx, columns):
    """First column of the rows at ``offset`` from their outlines' middles, and where they end: -1 if not ``known``."""
    u = offset * by_ry
    half = hx * tl.sqrt(tl.maximum(1.0 - u * u, 0.0))
    middle = xc + m * offset
    start = tl.math.ceil(tl.minimum(tl.maximum(middle - half, 0.0), columns + 0.0))
    return start, tl.where(known, tl.minimum(middle + half, columns - 0.5), -1.0)


@triton.jit(do_not_specialize=SIZES)
def _pixel_moments_kernel(
    record, grad, moments, count, rows, columns,
    CHANNELS: tl.constexpr, CONE: tl.constexpr, BLOCK_H: tl.constexpr, BLOCK_W: tl.constexpr,
    RUN: tl.constexpr, SPREAD: tl.constexpr,
):  # fmt: skip
    view = tl.program_id(1).to(tl.int64)
    record += view * count * RECORD
    moments += view * count * SUMS
    grad += view * rows * columns * SPREAD
    lane = tl.arange(0, 32)
    down, across = lane % 4 // BLOCK_W, lane % BLOCK_W
    zero = tl.zeros([32], tl.float32)
    lxx, lxy, lyy = zero, zero, zero
    for turn in range(RUN):
        n = (tl.program_id(0) * RUN + turn) * 8 + lane // 4
        at = record + tl.minimum(n, count - 1).to(tl.int64) * RECORD
        column0, row0, r11, r12 = load_four(at)
        r22, yc, ry, xc = load_four(at + 4)
        m, hx, lx, ly = load_four(at + 8)
        if CONE:
            lxx, lxy, lyy, _ = load_four(at + 12)
        w0, w1, w2, w3 = load_four(at + 16)
        h_sum, ht, hu, htt, htu, huu = zero, zero, zero, zero, zero, zero
        k, kt, ku, ktt, ktu, kuu = zero, zero, zero, zero, zero, zero
        c0, c1, c2, c3 = zero, zero, zero, zero
        # The outlines' slack is for finding tiles; a pixel counts here where it counts in the image.
        hx -= SLACK
        # A Gaussian off the detector has no rows, from a pixel that exists all the same.
        low = tl.math.ceil(tl.minimum(tl.maximum(yc - ry, 0.0), rows - 1.0))
        high = tl.math.floor(tl.minimum(tl.maximum(yc + ry, -1.0), rows - 1.0))
        high = tl.where((ry > 0) & (n < count), high, -1.0)
        by_ry = 1.0 / tl.maximum(ry - SLACK, _TINY)
        i = low.to(tl.int32) + down
        offset = (low - yc) + down.to(tl.float32)
        last = high - yc
        for _first in range(0, tl.max((high - low + 1.0).to(tl.int32), 0), BLOCK_H):
            start, stop = _row_ends(offset, offset <= last + 0.5, by_ry, ry, xc, m, hx, columns)
            width = tl.max((stop - start + 1.0).to(tl.int32), 0)
            y = offset + (yc - row0)
            u = r22 * y
            uu = u * u
            # Lanes past their row's end read the pixels that follow, zeros or finite numbers.
            stop -= column0
            pixel = (
                grad + (tl.minimum(i, rows - 1) * columns + start.to(tl.int32) + across).to(tl.int64) * SPREAD
            )
            x = (start - column0) + across.to(tl.float32)
            l0, l1, shift = 1.0 + y * (ly + lyy * y), lx + lxy * y, r12 * y
            i += BLOCK_H
            offset += BLOCK_H
            h0, h1, k0, k1 = zero, zero, zero, zero
            for _walked in range(0, width, BLOCK_W):
                if CHANNELS == 1:
                    g0 = tl.load(pixel)
                else:
                    g0, g1, g2, g3 = load_four(pixel)
                t = r11 * x + shift
                q = t * t + uu
                inside = x <= stop
                if CONE:
                    # Far from a needle's footprint rounding can make l negative: no root is used there.
                    root = tl.where(inside, tl.math.rsqrt(tl.abs(l0 + x * (l1 + lxx * x))), 0.0)
                    inverse = root * root
                    q *= inverse
                    value = tl.exp2(-1.0 * q) * root
                else:
                    value = tl.where(inside, tl.exp2(-1.0 * q), 0.0)
                h = w0 * g0
                c0 += g0 * value
                if CHANNELS > 1:
                    h += w1 * g1
                    c1 += g1 * value
                if CHANNELS > 2:
                    h += w2 * g2
                    c2 += g2 * value
                if CHANNELS > 3:
                    h += w3 * g3
                    c3 += g3 * value
                h *= value
                if CONE:
                    h *= inverse
                along = h * t
                h0 += h
                h1 += along
                htt += along * t
                by_q = h * q
                k0 += by_q
                if CONE:
                    along = by_q * t
                    k1 += along
                    ktt += along * t
                x += BLOCK_W
                pixel += BLOCK_W * SPREAD
            ht += h1
            hu += h0 * u
            htu += h1 * u
            huu += h0 * (u * u)
            h_sum += h0
            k += k0
            if CONE:
                kt += k1
                ku += k0 * u
                ktu += k1 * u
                kuu += k0 * (u * u)
        s = h_sum - _TWO_LN2 * k
        st, su = ht - _TWO_LN2 * kt, hu - _TWO_LN2 * ku
        stt, stu, suu = htt - _TWO_LN2 * ktt, htu - _TWO_LN2 * ktu, huu - _TWO_LN2 * kuu
        store_sums(
            moments + n.to(tl.int64) * SUMS, n < count, lane,
            ht, hu, htt, htu, huu, s, st, su, stt, stu, suu, c0, c1, c2, c3, zero,
        )  # fmt: skip


def beyond(views: DetectorViews) -> int:
    """Pixels read after the last: a footprint's row starts on the detector and is walked for its width at most."""
    return 2 * views.columns + 32


def sum_moments(record, pixels: torch.Tensor, channels: int, views: DetectorViews) -> torch.Tensor:
    """(views, count, 16) sums over each footprint, with t = r11 x + r12 y and u = r22 y of the record.

    First of h (t, u, t^2, tu, u^2), from 5 of s (1, t, u, t^2, tu, u^2), from 11 of f dL/df by channel, where
    dL/d(distance^2 |e|^2) = -h / 2 and dL/d|e|^2 = -s / 2, all in units of |e_centre|. ``pixels`` is the gradient
    of the image of as many ``channels`` in the kernels' layout, with `beyond` zero pixels after it.
    """
    many, count = record.shape[:2]
    moments = record.new_empty((many, count, SUMS.value))
    block = _PLANAR_BLOCK if views.rows == 1 else BLOCK
    with on_device(record):
        _pixel_moments_kernel[(triton.cdiv(count, 8 * _RUN), many)](
            record, pixels, moments, count, views.rows, views.columns, CHANNELS=channels, CONE=views.cone,
            BLOCK_H=block[0], BLOCK_W=block[1], RUN=_RUN, SPREAD=spread(channels), num_warps=1, num_stages=1,
        )  # fmt: skip
    return moments
