"""The misfit of projections as the detector sees them, and its gradient, in three CUDA kernels.

What triton_misfit.py does where rays are sharp and one goes through each pixel. P is made first, for a pixel needs
its neighbours'; then the blurred P' is compared with what was measured; last, each ray gathers from the pixels that
its light reaches. The blur's matrix A (physics/detector_blur.py) is symmetric, so that both ways take the same weights:

    P'_k = sum_j A_kj P_j,   dP'_k / dP_j = A_kj,   dP'_k / dv = sum_j dA_kj/dv P_j

Where a pixel averages the light of n rays (physics/pixel_light.py), with p_i of each, the light is blurred:

    P_j = log n - log sum_i exp(-p_i),                dP_j / dp_i = exp(P_j - p_i) / n
    P'_k = P_k - log R_k,   R_k = sum_j A_kj exp(P_k - P_j),   dP'_k / dP_j = A_kj exp(P_k - P_j) / R_k
"""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.project.triton_image import folded, gradient_room, pixel_factor, place
from tomo_polysplat.kernels.step.mixed_light import MOST_BESIDE
from tomo_polysplat.kernels.step.triton_misfit import (
    PIXELS_A_PROGRAM,
    Splat,
    ray_misfit,
    sharp_projection,
    store_gradients,
)
from tomo_polysplat.kernels.step.triton_update import WHOLE_OF_BLUR
from tomo_polysplat.kernels.triton_maths import SIZES, on_device

__all__ = ["detected_misfit_gradient"]

_MOST = tl.constexpr(MOST_BESIDE)


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


@triton.jit(do_not_specialize=SIZES)
def _sharp_kernel(
    raw, sharp, table, log_weights, attenuation, behind, by_node, largest, area, columns, nodes, areal_scale,
    CURVES: tl.constexpr, FILTERED: tl.constexpr, CONE: tl.constexpr, DOWN: tl.constexpr, ACROSS: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    k = tl.program_id(1).to(tl.int64)
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    within = tl.minimum(pixel, area - 1)
    row, column = within // columns, within % columns
    largest_term, light = tl.full([BLOCK], float("-inf"), tl.float32), tl.zeros([BLOCK], tl.float32)
    for i in tl.static_range(DOWN):
        for j in tl.static_range(ACROSS):
            ray = (row * DOWN + i) * (columns * ACROSS) + column * ACROSS + j
            factor = pixel_factor(table, k, ray, columns * ACROSS, CONE) * areal_scale
            most, predicted, _, _, _ = sharp_projection(
                raw, k * area * (DOWN * ACROSS) + ray, factor, log_weights, attenuation, nodes,
                behind, by_node, within, area, CURVES, FILTERED,
            )  # fmt: skip
            tl.atomic_max(largest, tl.max(most, 0), sem="relaxed")
            if DOWN * ACROSS > 1:
                before, largest_term = largest_term, tl.maximum(largest_term, -predicted)
                light = light * tl.exp(before - largest_term) + tl.exp(-predicted - largest_term)
    if DOWN * ACROSS > 1:
        predicted = tl.log(DOWN * ACROSS / light) - largest_term
    tl.store(sharp + k * area + within, predicted, mask=pixel < area)


@triton.jit(do_not_specialize=SIZES)
def _blurred_kernel(
    sharp, slopes, blur, grad_blur, chosen, projections, totals, behind, sums,
    area, rows, columns, of_step, noise, held_out, corner,
    FILTERED: tl.constexpr, HUBER: tl.constexpr, LIGHT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    k = tl.program_id(1).to(tl.int64)
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < area
    row, column, variance = pixel // columns, pixel % columns, tl.load(blur)
    image = sharp + k * area
    own = tl.load(image + pixel, mask=inside, other=0.0)
    predicted, by_variance = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32)
    for i in tl.static_range(-1, 2):
        along_v, slope_v, there_v = _taps(row, rows, i, variance)
        for j in tl.static_range(-1, 2):
            along_u, slope_u, there_u = _taps(column, columns, j, variance)
            there = inside & there_v & there_u
            beside = tl.load(image + pixel + i * columns + j, mask=there, other=0.0)
            if LIGHT:
                beside = tl.exp(tl.minimum(own - beside, _MOST))
            predicted += along_v * along_u * beside
            by_variance += (slope_v * along_u + along_v * slope_u) * beside
    ratio = predicted
    if LIGHT:
        ratio = tl.where(inside, predicted, 1.0)
        predicted, by_variance = own - tl.log(ratio), -by_variance / ratio
    slope = ray_misfit(
        predicted, projections, totals, chosen, sums, k, pixel, inside, area, of_step, noise, held_out,
        corner, behind, HUBER, FILTERED,
    )  # fmt: skip
    slope = tl.where(inside, slope, 0.0)
    total = tl.sum((slope * by_variance).to(tl.float64), 0)
    tl.atomic_add(grad_blur, (total * WHOLE_OF_BLUR).to(tl.int64), sem="relaxed")
    if LIGHT:
        slope /= ratio
    tl.store(slopes + k * area + pixel, slope, mask=inside)


@triton.jit(do_not_specialize=SIZES)
def _gather_kernel(
    raw, sharp, pixels, table, slopes, blur, log_weights, attenuation, behind, by_node,
    area, rows, columns, room, beyond, many, nodes, areal_scale,
    CURVES: tl.constexpr, FILTERED: tl.constexpr, CONE: tl.constexpr, FOLD: tl.constexpr,
    DOWN: tl.constexpr, ACROSS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    k = tl.program_id(1).to(tl.int64)
    ray = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    rays, rays_across = area * (DOWN * ACROSS), columns * ACROSS
    inside = ray < rays
    live = ray < room + tl.where(k == many - 1, beyond, 0)
    row, column, variance = ray // (rays_across * DOWN), (ray % rays_across) // ACROSS, tl.load(blur)
    pixel = row * columns + column
    factor = pixel_factor(table, k, ray, rays_across, CONE) * areal_scale
    at = k * rays + tl.minimum(ray, rays - 1)
    _, predicted, d0, d1, d2 = sharp_projection(
        raw, at, factor, log_weights, attenuation, nodes, behind, by_node, tl.minimum(pixel, area - 1), area,
        CURVES, FILTERED,
    )  # fmt: skip
    gathered, averaged = tl.zeros([BLOCK], tl.float32), predicted
    if DOWN * ACROSS > 1:
        averaged = tl.load(sharp + k * area + pixel, mask=inside, other=0.0)
    for i in tl.static_range(-1, 2):
        along_v, _, there_v = _taps(row, rows, i, variance)
        for j in tl.static_range(-1, 2):
            along_u, _, there_u = _taps(column, columns, j, variance)
            there = inside & there_v & there_u
            slope = tl.load(slopes + k * area + pixel + i * columns + j, mask=there, other=0.0)
            if DOWN * ACROSS > 1:
                seen_by = tl.load(sharp + k * area + pixel + i * columns + j, mask=there, other=0.0)
                slope *= tl.exp(tl.minimum(seen_by - averaged, _MOST))
            gathered += along_v * along_u * slope
    if DOWN * ACROSS > 1:
        gathered *= tl.where(inside, tl.exp(averaged - predicted) / (DOWN * ACROSS), 0.0)
    to = k * room + place(ray, rays_across, FOLD)
    store_gradients(pixels, to, gathered * factor, d0, d1, d2, live, CURVES)


def detected_misfit_gradient(splat: Splat, blur: torch.Tensor, grad_blur: torch.Tensor) -> torch.Tensor:
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
    (behind, by_node), filtered = splat.filters(), measurement.behind is not None
    down, across = splat.parts
    rows, columns = views.rows // down, views.columns // across
    # Each begins at 16 bytes whatever the batch: elsewhere the kernels would be compiled once more.
    sharp = torch.empty(len(views) * splat.area, dtype=torch.float32, device=splat.raw.device)
    slopes = torch.empty_like(sharp)
    with on_device(splat.raw):
        _sharp_kernel[splat.blocks()](
            splat.raw, sharp, splat.table, log_weights, attenuation, behind, by_node, splat.largest,
            splat.area, columns, nodes, measurement.areal_scale,
            CURVES=measurement.curves, FILTERED=filtered, CONE=views.cone, DOWN=down, ACROSS=across,
            BLOCK=PIXELS_A_PROGRAM, num_warps=4,
        )  # fmt: skip
        _blurred_kernel[splat.blocks()](
            sharp, slopes, blur, grad_blur, splat.chosen, measurement.projections, measurement.totals,
            behind, splat.sums, splat.area, rows, columns, splat.of_step,
            measurement.noise, measurement.held_out, measurement.corner,
            FILTERED=filtered, HUBER=measurement.corner > 0, LIGHT=down * across > 1,
            BLOCK=PIXELS_A_PROGRAM, num_warps=4,
        )  # fmt: skip
        _gather_kernel[splat.gradient_blocks()](
            splat.raw, sharp, pixels, splat.table, slopes, blur, log_weights, attenuation,
            behind, by_node, splat.area, rows, columns, *gradient_room(views), len(views), nodes,
            measurement.areal_scale, CURVES=measurement.curves, FILTERED=filtered, CONE=views.cone,
            FOLD=folded(views),
            DOWN=down, ACROSS=across, BLOCK=PIXELS_A_PROGRAM, num_warps=4,
        )  # fmt: skip
    return pixels
