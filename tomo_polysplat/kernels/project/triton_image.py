"""Images as the CUDA kernels lay them out, and the factor of a pixel, sqrt(2 pi) times its ray's length.

Several channels lie side by side, four to a pixel, so that one lane reads or adds all of a pixel at once; a
single channel lies alone. ``finish_image`` goes from there to (channels, views, rows, columns),
``lay_out_gradient`` comes back.

Pixels of an image lie row by row. Those of a gradient lie by pairs of rows, the two of a column side by side, so
that the two lanes of a Gaussian, one in either row, read one line of the cache: it answers one line at a time, and that
is what the adjoint would wait for. After an odd last row and after the last view come zeros.
"""

from __future__ import annotations

import math

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.project.triton_setup import VIEW
from tomo_polysplat.kernels.triton_lanes import load_four, store_four
from tomo_polysplat.kernels.triton_maths import SIZES, on_device
from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["finish_image", "folded", "gradient_room", "lay_out_gradient", "pixel_factor", "place", "spread"]

_BLOCK = 256
_ROOT_TWO_PI = tl.constexpr(math.sqrt(2 * math.pi))


def spread(channels: int) -> int:
    """Floats a pixel takes in the kernels' layout."""
    return 1 if channels == 1 else 4


def folded(views: DetectorViews) -> int:
    """Rows that lie interleaved in the layout of a gradient: 2, and 1 where there is one row."""
    return 1 if views.rows == 1 else 2


def gradient_room(views: DetectorViews) -> tuple[int, int]:
    """Pixels of a view in the layout of a gradient, and those of zeros after the last view.

    A footprint's rows start on the detector and are walked for its width at most, and a little.
    """
    line = views.columns * folded(views)
    return triton.cdiv(views.rows, folded(views)) * line, triton.cdiv(
        views.columns + 32, views.columns
    ) * line


@triton.jit
def place(pixel, columns, FOLD: tl.constexpr):
    """Where in the layout of a gradient the pixels lie, counted row by row in a view."""
    if FOLD == 1:
        return pixel
    row = pixel // columns
    return ((row // FOLD) * columns + (pixel - row * columns)) * FOLD + row % FOLD


@triton.jit
def pixel_factor(views, view, pixel, columns, CONE: tl.constexpr):
    """sqrt(2 pi) times the length of the ray of each pixel, counted row by row."""
    at = views + view * VIEW
    d0, d1, d2 = tl.load(at + 14), tl.load(at + 17), tl.load(at + 20)
    if CONE:
        row = pixel // columns
        i, j = row.to(tl.float64), (pixel - row * columns).to(tl.float64)
        d0 += j * tl.load(at + 12) + i * tl.load(at + 13)
        d1 += j * tl.load(at + 15) + i * tl.load(at + 16)
        d2 += j * tl.load(at + 18) + i * tl.load(at + 19)
    return _ROOT_TWO_PI * tl.sqrt((d0 * d0 + d1 * d1 + d2 * d2).to(tl.float32))


@triton.jit(do_not_specialize=SIZES)
def _finish_kernel(
    raw, image, views, area, columns, CHANNELS: tl.constexpr, CONE: tl.constexpr, BLOCK: tl.constexpr
):
    view = tl.program_id(1).to(tl.int64)
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = pixel < area
    pixel = tl.minimum(pixel, area - 1)
    factor = pixel_factor(views, view, pixel, columns, CONE)
    at = view * area + pixel
    plane = tl.num_programs(1).to(tl.int64) * area
    if CHANNELS == 1:
        tl.store(image + at, tl.load(raw + at) * factor, mask=live)
    else:
        v0, v1, v2, v3 = load_four(raw + 4 * at)
        tl.store(image + at, v0 * factor, mask=live)
        tl.store(image + plane + at, v1 * factor, mask=live)
        if CHANNELS > 2:
            tl.store(image + 2 * plane + at, v2 * factor, mask=live)
        if CHANNELS > 3:
            tl.store(image + 3 * plane + at, v3 * factor, mask=live)


def finish_image(raw: torch.Tensor, table: torch.Tensor, channels: int, views: DetectorViews) -> torch.Tensor:
    """(channels, views, rows, columns) from the kernels' layout, times the factor of the pixel."""
    image = raw.new_empty((channels, len(views), views.rows, views.columns))
    area = views.rows * views.columns
    if area and len(views):
        with on_device(raw):
            _finish_kernel[(triton.cdiv(area, _BLOCK), len(views))](
                raw, image, table, area, views.columns, CHANNELS=channels, CONE=views.cone, BLOCK=_BLOCK,
                num_warps=4,
            )  # fmt: skip
    return image


@triton.jit(do_not_specialize=SIZES)
def _lay_out_kernel(
    grad, pixels, views, area, columns, room, beyond,
    CHANNELS: tl.constexpr, CONE: tl.constexpr, FOLD: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    view = tl.program_id(1).to(tl.int64)
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < area
    live = pixel < room + tl.where(view == tl.num_programs(1) - 1, beyond, 0)
    factor = pixel_factor(views, view, pixel, columns, CONE)
    at = view * area + pixel
    to = view * room + place(pixel, columns, FOLD)
    plane = tl.num_programs(1).to(tl.int64) * area
    g0 = tl.load(grad + at, mask=inside, other=0.0) * factor
    if CHANNELS == 1:
        tl.store(pixels + to, g0, mask=live)
    else:
        g1 = tl.load(grad + plane + at, mask=inside, other=0.0) * factor
        g2, g3 = tl.zeros_like(g0), tl.zeros_like(g0)
        if CHANNELS > 2:
            g2 = tl.load(grad + 2 * plane + at, mask=inside, other=0.0) * factor
        if CHANNELS > 3:
            g3 = tl.load(grad + 3 * plane + at, mask=inside, other=0.0) * factor
        store_four(pixels + 4 * to, g0, g1, g2, g3, live)


def lay_out_gradient(grad_image: torch.Tensor, table: torch.Tensor, views: DetectorViews) -> torch.Tensor:
    """The gradient of an image (channels, views, rows, columns), times the factor of the pixel, as it is laid out."""
    channels, (room, beyond) = len(grad_image), gradient_room(views)
    grad_image = grad_image.contiguous()
    pixels = grad_image.new_empty((len(views) * room + beyond) * spread(channels))
    with on_device(grad_image):
        _lay_out_kernel[(triton.cdiv(room + beyond, _BLOCK), len(views))](
            grad_image, pixels, table, views.rows * views.columns, views.columns, room, beyond,
            CHANNELS=channels, CONE=views.cone, FOLD=folded(views), BLOCK=_BLOCK, num_warps=4,
        )  # fmt: skip
    return pixels
