"""The misfit of projections seen through the detector's blur, and its gradient, in three CUDA kernels.

What triton_misfit.py does where rays are sharp. P is made first, for a pixel needs its neighbours'; then the
blurred P' is compared with what was measured; last, each pixel gathers from those that its light reaches. The
blur's matrix A (physics/detector_blur.py) is symmetric, so that both ways take the same weights:

    P'_k = -log sum_j A_kj exp(-P_j),   dP'_k / dP_j = A_kj exp(P'_k - P_j),
    dP'_k / dv = -sum_j dA_kj/dv exp(P'_k - P_j)
"""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.project.triton_image import pixel_factor
from tomo_polysplat.kernels.step.triton_misfit import (
    PIXELS_A_PROGRAM,
    Splat,
    ray_misfit,
    sharp_projection,
    store_gradients,
)
from tomo_polysplat.kernels.step.triton_update import WHOLE_OF_BLUR
from tomo_polysplat.kernels.triton_maths import on_device

__all__ = ["blurred_misfit_gradient"]

_TINY = tl.constexpr(1.1754944e-38)
# d log(passed) / dv counts so much at most: without a blur it is e^P in an opaque ray beside a free one. As the slopes
# of all rays add up to 1 at most, what is added up in whole numbers then never exceeds an int64.
_STEEPEST = tl.constexpr(2.0**22)


@triton.jit
def _taps(index, count, STEP: tl.constexpr, variance):
    """Weight of the neighbour at ``STEP`` along an axis, its slope by the variance, and whether it exists.

    Beyond the border lies the border's own pixel again.
    """
    beside = tl.where(count > 1, 0.5 * variance, 0.0)
    slope = tl.where(count > 1, 0.5, 0.0)
    if STEP == 0:
        again = tl.where(index == 0, 1.0, 0.0) + tl.where(index == count - 1, 1.0, 0.0)
        return 1 - 2 * beside + again * beside, (again - 2) * slope, index >= 0
    there = (index + STEP >= 0) & (index + STEP < count)
    return tl.where(there, beside, 0.0), tl.where(there, slope, 0.0), there


@triton.jit
def _sharp_kernel(
    raw, sharp, table, log_weights, attenuation, largest, area, columns, nodes, areal_scale,
    CURVES: tl.constexpr, CONE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    k = tl.program_id(1).to(tl.int64)
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    factor = pixel_factor(table, k, pixel, columns, CONE) * areal_scale
    at = k * area + tl.minimum(pixel, area - 1)
    most, predicted, _, _, _ = sharp_projection(raw, at, factor, log_weights, attenuation, nodes, CURVES)
    tl.atomic_max(largest, tl.max(most, 0), sem="relaxed")
    tl.store(sharp + at, predicted, mask=pixel < area)


@triton.jit
def _blurred_kernel(
    sharp, seen, slopes, blur, grad_blur, chosen, projections, totals, sums,
    area, rows, columns, noise, held_out, corner,
    HUBER: tl.constexpr, MANY: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    k = tl.program_id(1).to(tl.int64)
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < area
    row, column, variance = pixel // columns, pixel % columns, tl.load(blur)
    image = sharp + k * area
    brightest = tl.load(image + pixel, mask=inside, other=0.0)
    for i in tl.static_range(-1, 2):
        for j in tl.static_range(-1, 2):
            there = inside & (row + i >= 0) & (row + i < rows) & (column + j >= 0) & (column + j < columns)
            beside = tl.load(image + pixel + i * columns + j, mask=there, other=float("inf"))
            brightest = tl.minimum(brightest, beside)
    passed, by_variance = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32)
    for i in tl.static_range(-1, 2):
        along_v, slope_v, there_v = _taps(row, rows, i, variance)
        for j in tl.static_range(-1, 2):
            along_u, slope_u, there_u = _taps(column, columns, j, variance)
            there = inside & there_v & there_u
            beside = tl.load(image + pixel + i * columns + j, mask=there, other=float("inf"))
            light = tl.exp(brightest - beside)
            passed += along_v * along_u * light
            by_variance += (slope_v * along_u + along_v * slope_u) * light
    # What is not a number stays so: it ends the run.
    kept = ~(passed <= _TINY)
    passed = tl.where(kept, passed, _TINY)
    predicted = brightest - tl.log(passed)
    slope = ray_misfit(
        predicted, projections, totals, chosen, sums, k, pixel, inside, area, noise, held_out, corner,
        HUBER, MANY,
    )  # fmt: skip
    slope = tl.where(kept & inside, slope, 0.0)
    steep = tl.minimum(tl.maximum(by_variance / passed, -_STEEPEST), _STEEPEST)
    total = tl.sum(tl.where(kept & inside, -slope * steep, 0.0).to(tl.float64), 0)
    tl.atomic_add(grad_blur, (total * WHOLE_OF_BLUR).to(tl.int64), sem="relaxed")
    tl.store(seen + k * area + pixel, predicted, mask=inside)
    tl.store(slopes + k * area + pixel, slope, mask=inside)


@triton.jit
def _gather_kernel(
    raw, pixels, table, sharp, seen, slopes, blur, log_weights, attenuation,
    area, rows, columns, beyond, nodes, areal_scale,
    CURVES: tl.constexpr, CONE: tl.constexpr, MANY: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    k = tl.program_id(1).to(tl.int64)
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < area
    live = pixel < tl.where(k == MANY - 1, area + beyond, area)
    row, column, variance = pixel // columns, pixel % columns, tl.load(blur)
    factor = pixel_factor(table, k, pixel, columns, CONE) * areal_scale
    at = k * area + tl.minimum(pixel, area - 1)
    _, _, d0, d1, d2 = sharp_projection(raw, at, factor, log_weights, attenuation, nodes, CURVES)
    own = tl.load(sharp + at)
    gathered = tl.zeros([BLOCK], tl.float32)
    for i in tl.static_range(-1, 2):
        along_v, _, there_v = _taps(row, rows, i, variance)
        for j in tl.static_range(-1, 2):
            along_u, _, there_u = _taps(column, columns, j, variance)
            there, weight = inside & there_v & there_u, along_v * along_u
            to = k * area + pixel + i * columns + j
            slope = tl.load(slopes + to, mask=there, other=0.0)
            shift = tl.load(seen + to, mask=there, other=0.0) - own
            # The product is at most 1; what it is made of may be beyond a float.
            share = tl.exp(tl.minimum(shift + tl.log(tl.maximum(weight, _TINY)), 0.0))
            gathered += tl.where(weight > 0, slope * share, 0.0)
    store_gradients(pixels, k * area + pixel, gathered * factor, d0, d1, d2, live, CURVES)


def blurred_misfit_gradient(splat: Splat, blur: torch.Tensor, grad_blur: torch.Tensor) -> torch.Tensor:
    """The gradient of the misfit, as `Splat.gradient` lays it out.

    Parameters
    ----------
    splat : Splat
    blur : (1,) float32 tensor
        Variance of the detector's blur, in squared pixels.
    grad_blur : (1,) int64 tensor
        To which the gradient by it is added, times `WHOLE_OF_BLUR`.
    """
    views, measurement, pixels = splat.views, splat.measurement, splat.gradient()
    log_weights, attenuation, nodes = splat.spectrum()
    size = (3, len(views) * splat.area)
    sharp, seen, slopes = torch.empty(size, dtype=torch.float32, device=splat.raw.device)
    with on_device(splat.raw):
        _sharp_kernel[splat.blocks()](
            splat.raw, sharp, splat.table, log_weights, attenuation, splat.largest,
            splat.area, views.columns, nodes, measurement.areal_scale,
            CURVES=measurement.curves, CONE=views.cone, BLOCK=PIXELS_A_PROGRAM, num_warps=4,
        )  # fmt: skip
        _blurred_kernel[splat.blocks()](
            sharp, seen, slopes, blur, grad_blur, splat.chosen, measurement.projections, measurement.totals,
            splat.sums, splat.area, views.rows, views.columns,
            measurement.noise, measurement.held_out, measurement.corner,
            HUBER=measurement.corner > 0, MANY=len(views), BLOCK=PIXELS_A_PROGRAM, num_warps=4,
        )  # fmt: skip
        _gather_kernel[splat.blocks(splat.beyond)](
            splat.raw, pixels, splat.table, sharp, seen, slopes, blur, log_weights, attenuation,
            splat.area, views.rows, views.columns, splat.beyond, nodes, measurement.areal_scale,
            CURVES=measurement.curves, CONE=views.cone, MANY=len(views), BLOCK=PIXELS_A_PROGRAM, num_warps=4,
        )  # fmt: skip
    return pixels
