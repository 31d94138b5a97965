"""The projection on CUDA: every tile of pixels gathers the Gaussians that reach it.

A tile finds them through the bounding boxes of groups of neighbours in the list, then through their
outlines, so the order of the sum is that of the list: no atomics, the same bits on every run. The search is
quick when Gaussians near in the list are near in space.
"""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.project.triton_setup import RECORD
from tomo_polysplat.kernels.triton_maths import GROUP, HALF_LOG2E, lane_set, lowest_lane, on_device
from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["TILE", "footprint_value", "gather_image", "squared_length"]

TILE = (8, 16)  # rows and columns of a tile, handled by one warp
_PROGRAMS = 1 << 14  # enough to even out the tiles' loads; fewer tiles are each shared by several programs
_MOST_PARTS = 8


@triton.jit
def squared_length(x, y, lx, ly, lxx, lxy, lyy):
    """l of a pixel: |e|^2 in units of its value at the projected centre; see triton_setup."""
    return (1.0 + y * (ly + lyy * y)) + x * ((lx + lxy * y) + lxx * x)


@triton.jit
def footprint_value(x, y, r11, r12, r22, length, cut, CONE: tl.constexpr):
    """2^-q / sqrt(l) within the cut, zero beyond, then -q and 1 / l, of pixels with l = ``length``."""
    t, up = r11 * x + r12 * y, r22 * y
    minus = -(t * t + up * up)
    if CONE:
        root = tl.math.rsqrt(length)
        inverse = root * root
        minus *= inverse
        value = tl.exp2(minus) * root
    else:
        inverse = 1.0
        value = tl.exp2(minus)
    return tl.where(minus >= -cut, value, 0.0), minus, inverse


@triton.jit
def _reaches(ellipse, n, count, left, right, top, bottom):
    """Whether the outlines of the Gaussians ``n``, within the rows of a tile, reach its columns."""
    live = n < count
    yc = tl.load(ellipse + n, mask=live, other=0.0)
    ry = tl.load(ellipse + count + n, mask=live, other=-1.0)
    xc = tl.load(ellipse + 2 * count + n, mask=live, other=0.0)
    m = tl.load(ellipse + 3 * count + n, mask=live, other=0.0)
    hx = tl.load(ellipse + 4 * count + n, mask=live, other=1.0)
    low, high = tl.maximum(top - yc, -ry), tl.minimum(bottom - yc, ry)
    # The outline's rightmost point lies ``ahead`` rows below the centre and its leftmost as many above.
    ahead = m * ry * ry * tl.math.rsqrt(m * m * ry * ry + hx * hx)
    y_right = tl.minimum(tl.maximum(ahead, low), high)
    y_left = tl.minimum(tl.maximum(-ahead, low), high)
    u_right, u_left = y_right / ry, y_left / ry
    x_right = xc + m * y_right + hx * tl.sqrt(tl.maximum(1.0 - u_right * u_right, 0.0))
    x_left = xc + m * y_left - hx * tl.sqrt(tl.maximum(1.0 - u_left * u_left, 0.0))
    return (low <= high) & (x_right >= left) & (x_left <= right)


@triton.jit
def _gather_kernel(
    record, ellipse, boxes, image, count, groups, rows, columns, cut,
    CHANNELS: tl.constexpr, CONE: tl.constexpr, TILE_H: tl.constexpr, TILE_W: tl.constexpr,
    PARTS: tl.constexpr, GROUP: tl.constexpr,
):  # fmt: skip
    across = tl.cdiv(columns, TILE_W)
    left, top = (tl.program_id(0) % across) * TILE_W, (tl.program_id(0) // across) * TILE_H
    view = (tl.program_id(1) // PARTS).to(tl.int64)
    part = tl.program_id(1) % PARTS
    record += view * count * RECORD
    ellipse += view * 5 * count
    boxes += view * 4 * groups
    lane = tl.arange(0, GROUP)
    j, i = left + tl.arange(0, TILE_W), top + tl.arange(0, TILE_H)
    column, row = j.to(tl.float32)[None, :], i.to(tl.float32)[:, None]
    x0, y0 = left.to(tl.float32), top.to(tl.float32)
    x1, y1 = x0 + (TILE_W - 1), y0 + (TILE_H - 1)
    sum0 = tl.zeros([TILE_H, TILE_W], tl.float32)
    sum1, sum2, sum3 = sum0, sum0, sum0
    lx, ly, lxx, lxy, lyy = 0.0, 0.0, 0.0, 0.0, 0.0
    for first in range(part * GROUP, groups, PARTS * GROUP):
        box, known = boxes + first + lane, first + lane < groups
        meets = tl.load(box, mask=known, other=0.0) <= x1
        meets &= tl.load(box + groups, mask=known, other=0.0) >= x0
        meets &= tl.load(box + 2 * groups, mask=known, other=0.0) <= y1
        meets &= tl.load(box + 3 * groups, mask=known, other=0.0) >= y0
        near = lane_set(meets & known, lane)
        while near != 0:
            start = (first + lowest_lane(near)) * GROUP
            near &= near - 1
            found = lane_set(_reaches(ellipse, start + lane, count, x0, x1, y0, y1), lane)
            while found != 0:
                at = record + (start + lowest_lane(found)).to(tl.int64) * RECORD
                found &= found - 1
                x, y = column - tl.load(at), row - tl.load(at + 1)
                r11, r12, r22 = tl.load(at + 2), tl.load(at + 3), tl.load(at + 4)
                if CONE:
                    lx, ly = tl.load(at + 5), tl.load(at + 6)
                    lxx, lxy, lyy = tl.load(at + 7), tl.load(at + 8), tl.load(at + 9)
                value, _, _ = footprint_value(
                    x, y, r11, r12, r22, squared_length(x, y, lx, ly, lxx, lxy, lyy), cut, CONE
                )
                sum0 += tl.load(at + 11) * value
                if CHANNELS > 1:
                    sum1 += tl.load(at + 12) * value
                if CHANNELS > 2:
                    sum2 += tl.load(at + 13) * value
                if CHANNELS > 3:
                    sum3 += tl.load(at + 14) * value
    views = tl.num_programs(1) // PARTS
    inside = (i[:, None] < rows) & (j[None, :] < columns)
    # image: (parts, channels, views, rows, columns)
    stride = views.to(tl.int64) * rows * columns
    pixel = (
        image
        + part * CHANNELS * stride
        + view * rows * columns
        + i[:, None].to(tl.int64) * columns
        + j[None, :]
    )
    tl.store(pixel, sum0, mask=inside)
    if CHANNELS > 1:
        tl.store(pixel + stride, sum1, mask=inside)
    if CHANNELS > 2:
        tl.store(pixel + 2 * stride, sum2, mask=inside)
    if CHANNELS > 3:
        tl.store(pixel + 3 * stride, sum3, mask=inside)


def gather_image(record, ellipse, boxes, channels: int, views: DetectorViews, cutoff: float) -> torch.Tensor:
    """Image (channels, views, rows, columns) of the footprints, without the pixel factor."""
    many, count = record.shape[:2]
    shape = (channels, many, views.rows, views.columns)
    if not (count and many):
        return record.new_zeros(shape)
    tiles = triton.cdiv(views.rows, TILE[0]) * triton.cdiv(views.columns, TILE[1])
    parts = max(1, min(_MOST_PARTS, _PROGRAMS // (tiles * many), triton.cdiv(boxes.shape[2], GROUP)))
    image = record.new_empty((parts, *shape))
    with on_device(record):
        _gather_kernel[(tiles, many * parts)](
            record, ellipse, boxes, image, count, boxes.shape[2], views.rows, views.columns,
            cutoff * cutoff * HALF_LOG2E, CHANNELS=channels, CONE=views.cone, TILE_H=TILE[0], TILE_W=TILE[1],
            PARTS=parts, GROUP=GROUP, num_warps=1, num_stages=1,
        )  # fmt: skip
    return image[0] if parts == 1 else image.sum(0)
