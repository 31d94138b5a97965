"""The adjoint of the projection on CUDA: every Gaussian gathers the gradients of its pixels, without atomics.

One warp sums over the pixels of a Gaussian in a view; triton_pull_back.py goes on from these sums.
"""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.project.triton_forward import footprint_value, squared_length
from tomo_polysplat.kernels.project.triton_setup import RECORD
from tomo_polysplat.kernels.triton_maths import HALF_LOG2E, on_device
from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["BLOCK", "MOMENTS", "sum_moments"]

BLOCK = (8, 4)  # rows and columns of the lanes that walk along the rows of a footprint
_RUN = 4  # neighbours in the list handled by one warp: their pixels overlap, so they stay in the cache
MOMENTS = tl.constexpr(16)
_TINY = tl.constexpr(1e-20)
_TWO_LN2 = tl.constexpr(1 / HALF_LOG2E)


@triton.jit
def _pixel_gradients(line, j, inside, CHANNELS: tl.constexpr):
    """The channels' gradients of pixels ``j`` of some rows; several channels lie in fours, read at once."""
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
    CHANNELS: tl.constexpr, CONE: tl.constexpr, BLOCK_H: tl.constexpr, BLOCK_W: tl.constexpr,
    RUN: tl.constexpr,
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
                # Far from a needle's footprint rounding can make l negative; its root would spoil the sums.
                length = tl.maximum(squared_length(x, y, lx, ly, lxx, lxy, lyy), _TINY)
                value, minus, inverse = footprint_value(x, y, r11, r12, r22, length, cut, CONE)
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
        out = moments + (view * count + n) * MOMENTS
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


def sum_moments(
    record, ellipse, grad_image: torch.Tensor, views: DetectorViews, cutoff: float
) -> torch.Tensor:
    """(views, count, 16) sums over each footprint, with x and y from the projected centre.

    First of h (x, y, x^2, xy, y^2), from 5 of s (1, x, y, x^2, xy, y^2), from 11 of f dL/df by channel, where
    dL/d(distance^2 |e|^2) = -h / 2 and dL/d|e|^2 = -s / 2, all in units of |e_centre|.
    """
    channels, (many, count) = len(grad_image), record.shape[:2]
    moments = record.new_empty((many, count, MOMENTS.value))
    pixels = grad_image.permute(1, 2, 3, 0)
    if channels > 1:
        pixels = torch.nn.functional.pad(pixels, (0, 4 - channels))
    with on_device(record):
        _moments_kernel[(triton.cdiv(count, _RUN), many)](
            record, ellipse, pixels.contiguous(), moments, count, views.rows, views.columns,
            cutoff * cutoff * HALF_LOG2E, CHANNELS=channels, CONE=views.cone, BLOCK_H=BLOCK[0],
            BLOCK_W=BLOCK[1],
            RUN=_RUN, num_warps=1, num_stages=1,
        )  # fmt: skip
    return moments
