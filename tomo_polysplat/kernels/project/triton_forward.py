"""The projection on CUDA: neighbours in the list are summed tile by tile and added to the image.

A warp holds the outlines of GROUP neighbours, one to a lane. For every tile of their common window it finds
those that reach the tile, sums them in registers, each half of the warp every other one, and adds the sum to
the image atomically: one addition for many Gaussians. Additions meet in any order, so the image repeats to
rounding (about 1e-7), and to the bit only where they are made exact.
The windows are small when Gaussians near in the list are near in space.
"""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.project.triton_image import spread
from tomo_polysplat.kernels.project.triton_setup import QUAD, RECORD
from tomo_polysplat.kernels.triton_lanes import (
    add_four,
    add_within,
    adds_four,
    lane_set,
    load_four,
    next_lane,
    odd_ranks,
    share_out,
)
from tomo_polysplat.kernels.triton_maths import GROUP, HALF_LOG2E, SIZES, grain, grained, on_device
from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["splat"]

_TILE_ROWS = 8  # and as many columns, or 64 of a single row: half a warp has four pixels a lane
_HALF = tl.constexpr(16)
_PROGRAMS = 1 << 14  # enough to fill the device; the windows of fewer groups are each shared out
_MOST_PARTS = 16
_FAR = tl.constexpr(1e30)


@triton.jit
def _outlines(record, lane):
    """yc, ry (-1 where there is no outline), xc, m, hx of a group's outlines; see triton_setup."""
    at = record + 4 * lane
    yc, ry, xc, m = load_four(at + 4 * QUAD)
    _, _, _, hx = load_four(at + 3 * QUAD)
    return yc, ry, xc, m, hx


@triton.jit
def _columns(yc, by_ry, ry, xc, m, hx, ahead, top, bottom, columns):
    """First and last column that the outlines reach between two rows; the last is -1 where they reach none."""
    low, high = tl.maximum(top - yc, -ry), tl.minimum(bottom - yc, ry)
    y_right, y_left = tl.minimum(tl.maximum(ahead, low), high), tl.minimum(tl.maximum(-ahead, low), high)
    u_right, u_left = y_right * by_ry, y_left * by_ry
    right = xc + m * y_right + hx * tl.sqrt(tl.maximum(1.0 - u_right * u_right, 0.0))
    left = xc + m * y_left - hx * tl.sqrt(tl.maximum(1.0 - u_left * u_left, 0.0))
    there = (low <= high) & (ry > 0)
    left = tl.where(there, tl.minimum(tl.maximum(left, 0.0), columns + 0.0), columns + 0.0)
    right = tl.where(there, tl.minimum(tl.maximum(right, -1.0), columns - 1.0), -1.0)
    first, last = tl.math.ceil(left).to(tl.int32), tl.math.floor(right).to(tl.int32)
    return first, tl.where(first <= last, last, -1)


@triton.jit
def _add_value(
    a0, a1, a2, a3, t, uu, l0, l1, ltt, cut, w0, w1, w2, w3, CHANNELS: tl.constexpr, CONE: tl.constexpr
):
    """The sums of a pixel with what Gaussians add to it at ``t``."""
    q = t * t + uu
    if CONE:
        root = tl.math.rsqrt(l0 + t * (l1 + ltt * t))
        q *= root * root
        value = tl.exp2(-1.0 * q) * root
    else:
        value = tl.exp2(-1.0 * q)
    return add_within(a0, a1, a2, a3, q, cut, value, w0, w1, w2, w3, CHANNELS)


@triton.jit
def _sum_tile(
    record, found, odd, upper, column, row, cut,
    CHANNELS: tl.constexpr, CONE: tl.constexpr, STEP: tl.constexpr,
):  # fmt: skip
    """Sums of the Gaussians ``found`` at a row of every lane, from ``column`` on and STEP columns apart.

    Both halves of the warp have the same four pixels and every other Gaussian, the lower one those of ``odd`` rank.
    In the end the lower half has the sums of the first and the third pixel, by channel, and the ``upper`` half those
    of the second and fourth.
    """
    zero = tl.zeros([32], tl.float32)
    a0, a1, a2, a3, b0, b1, b2, b3 = zero, zero, zero, zero, zero, zero, zero, zero
    c0, c1, c2, c3, d0, d1, d2, d3 = zero, zero, zero, zero, zero, zero, zero, zero
    w3, lt, lu, ltt, ltu, luu = zero, zero, zero, zero, zero, zero
    lanes = tl.where(upper, found & ~odd, odd)
    while odd != 0:
        odd &= odd - 1
        which, limit, lanes = next_lane(lanes, cut)
        at = record + 4 * which
        column0, row0, r11, r12 = load_four(at)
        r22, lt, lu, ltt = load_four(at + QUAD)
        ltu, luu, w0, w1 = load_four(at + 2 * QUAD)
        w2 = zero
        if CHANNELS > 2:
            w2, w3, _, _ = load_four(at + 3 * QUAD)
        y = row - row0
        u = r22 * y
        uu, t, by = u * u, r11 * (column - column0) + r12 * y, STEP * r11
        l0, l1 = 1.0 + u * (lu + luu * u), lt + ltu * u
        a0, a1, a2, a3 = _add_value(a0, a1, a2, a3, t, uu, l0, l1, ltt, limit, w0, w1, w2, w3, CHANNELS, CONE)
        t += by
        b0, b1, b2, b3 = _add_value(b0, b1, b2, b3, t, uu, l0, l1, ltt, limit, w0, w1, w2, w3, CHANNELS, CONE)
        t += by
        c0, c1, c2, c3 = _add_value(c0, c1, c2, c3, t, uu, l0, l1, ltt, limit, w0, w1, w2, w3, CHANNELS, CONE)
        t += by
        d0, d1, d2, d3 = _add_value(d0, d1, d2, d3, t, uu, l0, l1, ltt, limit, w0, w1, w2, w3, CHANNELS, CONE)
    return share_out(a0, b0, c0, d0, a1, b1, c1, d1, a2, b2, c2, d2, a3, b3, c3, d3, CHANNELS)


@triton.jit
def _add_pixel(
    image, i, j, rows, columns, v0, v1, v2, v3, shift,
    CHANNELS: tl.constexpr, AT_ONCE: tl.constexpr, GRAINED: tl.constexpr,
):  # fmt: skip
    if GRAINED:
        v0, v1, v2, v3 = grained(v0, shift), grained(v1, shift), grained(v2, shift), grained(v3, shift)
    pixel = (i * columns + j).to(tl.int64)
    inside = (i < rows) & (j < columns)
    if CHANNELS == 1:
        tl.atomic_add(image + pixel, v0, mask=inside & (v0 != 0), sem="relaxed")
    else:
        add_four(image + 4 * pixel, v0, v1, v2, v3, inside, AT_ONCE)


@triton.jit(do_not_specialize=SIZES)
def _splat_pixels_kernel(
    record, image, largest, rows, columns, parts, cut,
    CHANNELS: tl.constexpr, CONE: tl.constexpr, ROWS: tl.constexpr,
    GROUP: tl.constexpr, AT_ONCE: tl.constexpr, GRAINED: tl.constexpr, SPREAD: tl.constexpr,
):  # fmt: skip
    shift = grain(largest, GRAINED)
    group, part = tl.program_id(0) // parts, tl.program_id(0) % parts
    view = tl.program_id(1).to(tl.int64)
    record += (view * (tl.num_programs(0) // parts) + group) * (GROUP * RECORD)
    image += view * rows * columns * SPREAD
    lane = tl.arange(0, GROUP)
    yc, ry, xc, m, hx = _outlines(record, lane)
    by_ry = 1.0 / ry
    # The outline's rightmost point lies ``ahead`` rows below the centre and its leftmost as many above.
    ahead = m * ry * ry / tl.sqrt(m * m * ry * ry + hx * hx)
    seen = ry > 0
    y_low = tl.maximum(tl.min(tl.where(seen, yc - ry, _FAR), 0), 0.0)
    y_high = tl.minimum(tl.max(tl.where(seen, yc + ry, -_FAR), 0), rows - 1.0)
    STEP: tl.constexpr = _HALF // ROWS
    COLUMNS: tl.constexpr = 4 * STEP
    upper, down, across = lane >= _HALF, lane % _HALF // STEP, lane % STEP
    # The parts of a window are every so many rows of tiles, or tiles where there is one row.
    below, down_by, beside, along_by = part * ROWS, parts * ROWS, 0, COLUMNS
    if ROWS == 1:
        below, down_by, beside, along_by = 0, 1, part * COLUMNS, parts * COLUMNS
    if y_low <= y_high:
        for top in range(y_low.to(tl.int32) + below, y_high.to(tl.int32) + 1, down_by):
            y0 = top + 0.0
            first, last = _columns(yc, by_ry, ry, xc, m, hx, ahead, y0, y0 + (ROWS - 1), columns)
            # From an even column: two pixels of four channels fill one sector of memory.
            for left in range(tl.min(first, 0) // 2 * 2 + beside, tl.max(last, 0) + 1, along_by):
                found = lane_set((first < left + COLUMNS) & (last >= left), lane)
                odd = odd_ranks(found)
                if odd != 0:
                    i, j = top + down, left + across
                    a0, a1, a2, a3, c0, c1, c2, c3 = _sum_tile(
                        record, found, odd, upper, j.to(tl.float32), i.to(tl.float32), cut, CHANNELS, CONE, STEP,
                    )  # fmt: skip
                    j += tl.where(upper, STEP, 0)
                    _add_pixel(image, i, j, rows, columns, a0, a1, a2, a3, shift, CHANNELS, AT_ONCE, GRAINED)
                    j += 2 * STEP
                    _add_pixel(image, i, j, rows, columns, c0, c1, c2, c3, shift, CHANNELS, AT_ONCE, GRAINED)


def splat(
    record,
    channels: int,
    views: DetectorViews,
    cutoff: float,
    largest: torch.Tensor | None = None,
    image: torch.Tensor | None = None,
) -> torch.Tensor:
    """Image of the footprints in the layout of triton_image, without the factor of the pixel; or ``image`` and it.

    With ``largest``, a float32 tensor of the largest value that such an image has had, it has the same bits every
    time: what is added is rounded to some 2e-7 of that (`grained`).
    """
    many, groups = record.shape[:2]
    if image is None:
        image = record.new_zeros((many, views.rows, views.columns, spread(channels)))
    if not (groups and image.numel()):
        return image
    parts = triton.next_power_of_2(max(1, min(_MOST_PARTS, _PROGRAMS // (groups * many))))
    with on_device(record):
        _splat_pixels_kernel[(groups * parts, many)](
            record, image, record if largest is None else largest, views.rows, views.columns,
            parts, cutoff * cutoff * HALF_LOG2E,
            CHANNELS=channels, CONE=views.cone, ROWS=1 if views.rows == 1 else _TILE_ROWS,
            GROUP=GROUP, AT_ONCE=adds_four(record.device), GRAINED=largest is not None, SPREAD=spread(channels),
            num_warps=1, num_stages=1,
        )  # fmt: skip
    return image
