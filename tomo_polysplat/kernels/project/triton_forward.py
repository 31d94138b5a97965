"""The projection on CUDA: neighbours in the list are summed tile by tile and added to the image.

A warp holds the outlines of GROUP neighbours, one to a lane. For every tile of their common window it finds
those that reach the tile, sums them in registers, and adds the sum to the image atomically: one addition for
many Gaussians. Additions meet in any order, so the image repeats to rounding (about 1e-7), and to the bit only
where they are made exact.
The windows are small when Gaussians near in the list are near in space.
"""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.project.triton_image import spread
from tomo_polysplat.kernels.project.triton_setup import RECORD
from tomo_polysplat.kernels.triton_lanes import add_four, adds_four, lane_set, load_four, lowest_lane
from tomo_polysplat.kernels.triton_maths import GROUP, HALF_LOG2E, SIZES, grain, grained, on_device
from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["TILE", "splat"]

TILE = (16, 8)  # rows and columns
_PLANAR_TILE = (1, 64)
_PROGRAMS = 1 << 15  # enough to fill the device; the windows of fewer groups are each shared out
_MOST_PARTS = 16
_FAR = tl.constexpr(1e30)


@triton.jit
def _outlines(record, group, count, GROUP: tl.constexpr):
    """yc, ry (-1 where there is no outline), xc, m, hx of a group's outlines; see triton_setup."""
    n = group * GROUP + tl.arange(0, GROUP)
    at = record + tl.minimum(n, count - 1).to(tl.int64) * RECORD
    _, yc, ry, xc = load_four(at + 4)
    m, hx, _, _ = load_four(at + 8)
    return yc, tl.where(n < count, ry, -1.0), xc, m, hx


@triton.jit
def _reaches(yc, ry, xc, m, hx, ahead, left, right, top, bottom):
    """Whether the outlines, within the rows of a tile, reach its columns."""
    low, high = tl.maximum(top - yc, -ry), tl.minimum(bottom - yc, ry)
    y_right, y_left = tl.minimum(tl.maximum(ahead, low), high), tl.minimum(tl.maximum(-ahead, low), high)
    u_right, u_left = y_right / ry, y_left / ry
    x_right = xc + m * y_right + hx * tl.sqrt(tl.maximum(1.0 - u_right * u_right, 0.0))
    x_left = xc + m * y_left - hx * tl.sqrt(tl.maximum(1.0 - u_left * u_left, 0.0))
    return (low <= high) & (x_right >= left) & (x_left <= right)


@triton.jit
def _sum_tile(
    record,
    found,
    left,
    top,
    cut,
    CHANNELS: tl.constexpr,
    CONE: tl.constexpr,
    H: tl.constexpr,
    W: tl.constexpr,
):
    """Sums of the Gaussians ``found`` over a tile, (columns, rows): so a lane has pixels of one row."""
    column = left.to(tl.float32) + tl.arange(0, W).to(tl.float32)[:, None]
    row = top.to(tl.float32) + tl.arange(0, H).to(tl.float32)[None, :]
    sum0 = tl.zeros([W, H], tl.float32)
    sum1, sum2, sum3 = sum0, sum0, sum0
    while found != 0:
        at = record + lowest_lane(found).to(tl.int64) * RECORD
        found &= found - 1
        column0, row0, r11, r12 = load_four(at)
        r22, _, _, _ = load_four(at + 4)
        w0, w1, w2, w3 = load_four(at + 16)
        x, y = column - column0, row - row0
        u = r22 * y
        t = r11 * x + r12 * y
        q = t * t + u * u
        if CONE:
            _, _, lx, ly = load_four(at + 8)
            lxx, lxy, lyy, _ = load_four(at + 12)
            length = (1.0 + y * (ly + lyy * y)) + x * ((lx + lxy * y) + lxx * x)
            root = tl.math.rsqrt(length)
            q *= root * root
            value = tl.where(q <= cut, tl.exp2(-1.0 * q) * root, 0.0)
        else:
            value = tl.where(q <= cut, tl.exp2(-1.0 * q), 0.0)
        sum0 += w0 * value
        if CHANNELS > 1:
            sum1 += w1 * value
        if CHANNELS > 2:
            sum2 += w2 * value
        if CHANNELS > 3:
            sum3 += w3 * value
    return sum0, sum1, sum2, sum3


@triton.jit(do_not_specialize=SIZES)
def _splat_kernel(
    record, image, largest, count, rows, columns, parts, cut,
    CHANNELS: tl.constexpr, CONE: tl.constexpr, TILE_H: tl.constexpr, TILE_W: tl.constexpr,
    GROUP: tl.constexpr, AT_ONCE: tl.constexpr, GRAINED: tl.constexpr,
):  # fmt: skip
    shift = grain(largest, GRAINED)
    group, part = tl.program_id(0) // parts, tl.program_id(0) % parts
    view = tl.program_id(1).to(tl.int64)
    record += view * count * RECORD
    yc, ry, xc, m, hx = _outlines(record, group, count, GROUP)
    record += group.to(tl.int64) * GROUP * RECORD
    reach = tl.sqrt(m * m * ry * ry + hx * hx)
    # The outline's rightmost point lies ``ahead`` rows below the centre and its leftmost as many above.
    ahead = m * ry * ry / reach
    seen = ry > 0
    x_low = tl.maximum(tl.min(tl.where(seen, xc - reach, _FAR), 0), 0.0)
    x_high = tl.minimum(tl.max(tl.where(seen, xc + reach, -_FAR), 0), columns - 1.0)
    y_low = tl.maximum(tl.min(tl.where(seen, yc - ry, _FAR), 0), 0.0)
    y_high = tl.minimum(tl.max(tl.where(seen, yc + ry, -_FAR), 0), rows - 1.0)
    if (x_low <= x_high) & (y_low <= y_high):
        # From an even column: two pixels of four channels fill one sector of memory.
        left0, top0 = x_low.to(tl.int32) // 2 * 2, y_low.to(tl.int32)
        across = (x_high.to(tl.int32) - left0) // TILE_W + 1
        tiles = ((y_high.to(tl.int32) - top0) // TILE_H + 1) * across
        for tile in range(part, tiles, parts):
            down = tile // across
            left, top = left0 + (tile - down * across) * TILE_W, top0 + down * TILE_H
            x0, y0 = left.to(tl.float32), top.to(tl.float32)
            hit = _reaches(yc, ry, xc, m, hx, ahead, x0, x0 + (TILE_W - 1), y0, y0 + (TILE_H - 1))
            found = lane_set(hit & seen, tl.arange(0, GROUP))
            if found != 0:
                sum0, sum1, sum2, sum3 = _sum_tile(
                    record, found, left, top, cut, CHANNELS, CONE, TILE_H, TILE_W
                )
                if GRAINED:
                    sum0, sum1 = grained(sum0, shift), grained(sum1, shift)
                    sum2, sum3 = grained(sum2, shift), grained(sum3, shift)
                j, i = left + tl.arange(0, TILE_W)[:, None], top + tl.arange(0, TILE_H)[None, :]
                pixel = (view * rows + i) * columns + j
                inside = (i < rows) & (j < columns)
                if CHANNELS == 1:
                    tl.atomic_add(image + pixel, sum0, mask=inside & (sum0 != 0), sem="relaxed")
                else:
                    inside &= (sum0 != 0) | (sum1 != 0) | (sum2 != 0) | (sum3 != 0)
                    add_four(image + 4 * pixel, sum0, sum1, sum2, sum3, inside, AT_ONCE)


def splat(
    record, channels: int, views: DetectorViews, cutoff: float, largest: torch.Tensor | None = None
) -> torch.Tensor:
    """Image of the footprints in the layout of triton_image, without the factor of the pixel.

    With ``largest``, a float32 tensor of the largest value that such an image has had, it has the same bits every
    time: what is added is rounded to some 2e-7 of that (`grained`).
    """
    many, count = record.shape[:2]
    image = record.new_zeros((many, views.rows, views.columns, spread(channels)))
    if not (count and image.numel()):
        return image
    groups = triton.cdiv(count, GROUP)
    parts = triton.next_power_of_2(max(1, min(_MOST_PARTS, _PROGRAMS // (groups * many))))
    tile = _PLANAR_TILE if views.rows == 1 else TILE
    with on_device(record):
        _splat_kernel[(groups * parts, many)](
            record, image, record if largest is None else largest, count, views.rows, views.columns,
            parts, cutoff * cutoff * HALF_LOG2E,
            CHANNELS=channels, CONE=views.cone, TILE_H=tile[0], TILE_W=tile[1], GROUP=GROUP,
            AT_ONCE=adds_four(record.device), GRAINED=largest is not None, num_warps=1, num_stages=1,
        )  # fmt: skip
    return image
