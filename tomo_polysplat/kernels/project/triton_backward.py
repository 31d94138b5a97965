"""The adjoint of the projection on CUDA: every Gaussian gathers the gradients of its pixels, without atomics.

Two lanes sum over the pixels of a Gaussian in a view; triton_pull_back.py goes on from these sums.
"""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.project.triton_image import folded, spread
from tomo_polysplat.kernels.project.triton_setup import QUAD, RECORD, SLACK
from tomo_polysplat.kernels.triton_lanes import SUMS, by_size, from_lane, load_four, store_sums, widest
from tomo_polysplat.kernels.triton_maths import GROUP, HALF_LOG2E, SIZES, on_device
from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["sum_moments"]

_TEAM = tl.constexpr(2 * GROUP)  # neighbours in the list among whom those of like size are found
_AT_ONCE = tl.constexpr(16)  # of these, two lanes each
_PROGRAMS = 1 << 14  # enough to fill the device: teams are shared out where there are fewer
# Of a lane, where a pixel has several channels. With fewer the compiler reads some of four pixels only when the ones
# before are done with, and every read is waited for (0.169 ms for the 200 000 footprints of the benchmark's first
# line with 92, 0.180 with 88, 0.199 with the 80 it would take); with more there are fewer warps to wait side by side.
_REGISTERS = 92
_TINY = tl.constexpr(1e-20)
_TWO_LN2 = tl.constexpr(1 / HALF_LOG2E)


@triton.jit
def _row_ends(offset, between, reach, by_ry, xc, m, hx, columns):
    """First and last column of rows at ``offset`` from their outlines' middles; last < first beyond ``reach``."""
    u = offset * by_ry
    rest = 1.0 - u * u
    half, middle = hx * tl.sqrt(tl.maximum(rest, 0.0)), xc + m * offset
    there = (rest > 0) & (tl.abs(offset - between) <= reach)
    start = tl.math.ceil(tl.minimum(tl.maximum(middle - half, 0.0), columns + 0.0))
    stop = tl.math.floor(tl.minimum(middle + half, columns - 1.0))
    return tl.where(there, start, columns + 0.0), tl.where(there, stop, -1.0)


@triton.jit
def _reach(own):
    """Half the height or the width of a group's footprints, whichever is more; 0 where there is none."""
    ry, hx = tl.load(own + (4 * QUAD + 1)), tl.load(own + (3 * QUAD + 3))
    return tl.where(ry > 0, tl.maximum(ry, hx), 0.0)


@triton.jit(do_not_specialize=SIZES)
def _pixel_moments_kernel(
    record, grad, moments, rows, columns, parts,
    CHANNELS: tl.constexpr, CONE: tl.constexpr, BLOCK_H: tl.constexpr, SPREAD: tl.constexpr, GROUP: tl.constexpr,
):  # fmt: skip
    view = tl.program_id(1).to(tl.int64)
    last_block = (rows - 1) // BLOCK_H
    # The largest footprints of all teams first: what runs last should not run long.
    teams = tl.num_programs(0) // parts
    team, part = tl.program_id(0) % teams, parts - 1 - tl.program_id(0) // teams
    first_one = (view * teams + team) * _TEAM
    record += first_one * RECORD
    moments += first_one * SUMS
    grad += view * (last_block + 1) * columns * (BLOCK_H * SPREAD)
    lane = tl.arange(0, 32)
    BLOCK_W: tl.constexpr = 2 // BLOCK_H
    down, across = lane % 2 // BLOCK_W, lane % BLOCK_W
    zero = tl.zeros([32], tl.float32)
    # What the warp does at a time takes as long as the largest footprint: like ones together.
    own = record + 4 * lane
    lower, upper = by_size(_reach(own), _reach(own + GROUP * RECORD), lane)
    for turn in range(part, _TEAM // _AT_ONCE, parts):
        ordered = tl.where(turn < GROUP // _AT_ONCE, lower, upper)
        n = from_lane(ordered, turn * _AT_ONCE % GROUP + lane // 2)
        at = record + (n // GROUP * (GROUP * RECORD) + n % GROUP * 4)
        column0, row0, r11, r12 = load_four(at)
        r22, lt, lu, ltt = load_four(at + QUAD)
        ltu, luu, w0, w1 = load_four(at + 2 * QUAD)
        w2, w3, unit, hx = load_four(at + 3 * QUAD)
        yc, ry, xc, m = load_four(at + 4 * QUAD)
        h_sum, ht, hu, htt, htu, huu = zero, zero, zero, zero, zero, zero
        k, kt, ku, ktt, ktu, kuu = zero, zero, zero, zero, zero, zero
        c0, c1, c2, c3 = zero, zero, zero, zero
        # The outlines' slack is for finding tiles; a pixel counts here where it counts in the image.
        hx -= SLACK
        # A Gaussian off the detector has no rows, by pixels that exist all the same.
        low = tl.math.ceil(tl.minimum(tl.maximum(yc - ry, 0.0), rows - 1.0))
        high = tl.math.floor(tl.minimum(tl.maximum(yc + ry, -1.0), rows - 1.0))
        between, reach = 0.5 * (low + high) - yc, 0.5 * (high - low) + 0.25
        reach = tl.where(ry > 0, reach, -1.0)
        by_ry = 1.0 / tl.maximum(ry - SLACK, _TINY)
        # The warp walks from the middles outwards in step: where all are widest they are wide together.
        block = tl.math.floor(tl.minimum(tl.maximum(yc + 0.5, low), high) / BLOCK_H).to(tl.int32)
        above = tl.max(tl.where(ry > 0, block - low.to(tl.int32) // BLOCK_H, 0), 0)
        below = tl.max(tl.where(ry > 0, high.to(tl.int32) // BLOCK_H - block, -1), 0)
        block -= above
        offset = (block * BLOCK_H + down).to(tl.float32) - yc
        for _pair in range(above + below + 1):
            start, stop = _row_ends(offset, between, reach, by_ry, xc, m, hx, columns)
            first, end = start, stop
            if BLOCK_H == 2:
                first, end = widest(start, stop)
            width = tl.max((end - first + 1.0).to(tl.int32), 0)
            y = offset + (yc - row0)
            u = r22 * y
            uu = u * u
            # Columns count from the middle of the row; what is read beside its ends is finite and not counted.
            middle = 0.5 * (start + stop)
            half = stop - middle + 0.25
            x = (first - middle) + across.to(tl.float32)
            line = tl.minimum(tl.maximum(block, 0), last_block) * columns
            pixel = (line + first.to(tl.int32) + across) * BLOCK_H + down
            pixel = grad + pixel.to(tl.int64) * SPREAD
            shift = r11 * (middle - column0) + r12 * y
            l0, l1 = 1.0 + u * (lu + luu * u), lt + ltu * u
            block += 1
            offset += BLOCK_H
            h0, h1, k0, k1 = zero, zero, zero, zero
            for _walked in range(0, width, BLOCK_W):
                if CHANNELS == 1:
                    g0 = tl.load(pixel)
                else:
                    g0, g1, g2, g3 = load_four(pixel)
                t = r11 * x + shift
                tt = t * t
                q = tt + uu
                inside = tl.abs(x) <= half
                if CONE:
                    # Far from a needle's footprint rounding can make l negative: no root is used there.
                    root = tl.where(inside, tl.math.rsqrt(tl.abs(l0 + t * (l1 + ltt * t))), 0.0)
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
                h0 += h
                h1 += h * t
                htt += h * tt
                by_q = h * q
                k0 += by_q
                if CONE:
                    k1 += by_q * t
                    ktt += by_q * tt
                x += BLOCK_W
                pixel += BLOCK_W * BLOCK_H * SPREAD
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
        unit = tl.where(ry > 0, 0.5 * unit, 0.0)  # of either lane
        s = h_sum - _TWO_LN2 * k
        st, su = ht - _TWO_LN2 * kt, hu - _TWO_LN2 * ku
        stt, stu, suu = htt - _TWO_LN2 * ktt, htu - _TWO_LN2 * ktu, huu - _TWO_LN2 * kuu
        store_sums(
            moments + n * SUMS, n >= 0, lane,
            ht, hu, htt, htu, huu, s, st, su, stt, stu, suu, c0, c1, c2, c3, unit, LANES=2,
        )  # fmt: skip


def sum_moments(record, pixels: torch.Tensor, channels: int, views: DetectorViews) -> torch.Tensor:
    """(views, Gaussians of whole groups, 16) sums over each footprint, with t = r11 x + r12 y and u = r22 y.

    First of h (t, u, t^2, tu, u^2), from 5 of s (1, t, u, t^2, tu, u^2), from 11 of f dL/df by channel, where
    dL/d(distance^2 |e|^2) = -h / 2 and dL/d|e|^2 = -s / 2, all in units of |e_centre|; last 1 / |e_centre| itself, 0
    for a Gaussian that misses the detector. ``pixels`` is the gradient of the image of as many ``channels`` in the
    kernels' layout for gradients.
    """
    many, groups = record.shape[:2]
    moments = record.new_empty((many, groups * GROUP, SUMS.value))
    teams = groups * GROUP // _TEAM.value
    parts = next((p for p in (4, 2) if p * teams * many <= _PROGRAMS), 1)
    with on_device(record):
        _pixel_moments_kernel[(teams * parts, many)](
            record, pixels, moments, views.rows, views.columns, parts, CHANNELS=channels, CONE=views.cone,
            BLOCK_H=folded(views), SPREAD=spread(channels), GROUP=GROUP, num_warps=1, num_stages=1,
            maxnreg=_REGISTERS if channels > 1 else None,
        )  # fmt: skip
    return moments
