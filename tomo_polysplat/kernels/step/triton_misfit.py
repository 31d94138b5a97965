"""Misfit of projections and its gradient, in one CUDA kernel after the splat and before its adjoint.

What ``fit.loss.misfit`` of ``FitScene.projections`` against ``Rays.batch`` says, pixel by pixel: the factor of
the pixel, the polychromatic projection, the weight of the ray, whether it is held out, the loss, and the way
back to the base materials' line integrals.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.project.triton_image import folded, gradient_room, pixel_factor, place, spread
from tomo_polysplat.kernels.triton_lanes import load_four, store_four
from tomo_polysplat.kernels.triton_maths import SIZES, on_device
from tomo_polysplat.kernels.views import DetectorViews

__all__ = [
    "Measurement",
    "PIXELS_A_PROGRAM",
    "Splat",
    "misfit_gradient",
    "ray_misfit",
    "sharp_projection",
    "store_gradients",
]

PIXELS_A_PROGRAM = 256


@dataclass(frozen=True, eq=False)
class Measurement:
    """The measured side of the misfit.

    Parameters
    ----------
    projections : (slots, rows, columns) float32 tensor
        -log(I/I0); NaN where a ray is not to be used.
    totals : (views,) float32 tensor
        Weight of the fitted rays of each view of the scan.
    noise : float
        Variance of an unattenuated ray over that of the model's error.
    held_out : int
        Of 65536 rays so many are held out.
    corner : float
        Residual over its deviation where the loss goes from squared to absolute; 0 for absolute everywhere.
    areal_scale : float
        Line integral of the kernels to g/cm2, or to -log(I/I0) without nodes.
    nodes : pair of tensors or None
        (n, 1) log weights and (n, 3) or (n, 1) attenuation of the spectrum.
    behind : tensor, optional
        (3, rows, columns) float32: areal density of the filter that each pixel is behind, P of the nodes through it
        alone, and -log of the share of the beam that passes it.
    by_node : tensor, optional
        (n,) attenuation of that filter at the nodes.
    """

    projections: torch.Tensor
    totals: torch.Tensor
    noise: float
    held_out: int
    corner: float
    areal_scale: float
    nodes: tuple[torch.Tensor, torch.Tensor] | None
    behind: torch.Tensor | None = None
    by_node: torch.Tensor | None = None

    @property
    def curves(self) -> int:
        """Curves that the spectrum is attenuated by; 0 without nodes."""
        return 0 if self.nodes is None else self.nodes[1].shape[1]


@dataclass(frozen=True, eq=False)
class Splat:
    """Splatted views, and what they are compared with.

    Parameters
    ----------
    raw : (views, rows, columns, ...) tensor
        Image of the splat.
    table : (views, 21) float64 tensor
        Of the rays.
    chosen : (2, views of the step) float64 tensor
        Number of each view in the scan, and its slot among the measured projections.
    views : DetectorViews
        As many views of the rays as are splatted; only their shape is read.
    parts : pair of int
        Rays of a pixel along rows' and columns' axis.
    measurement : Measurement
    sums : (3,) float64 tensor
        To which the mean misfit of the fitted rays, the sum of that of the held-out rays, and their weight are
        added.
    largest : float32 tensor of one number
        Raised to the largest value of ``raw``.
    """

    raw: torch.Tensor
    table: torch.Tensor
    chosen: torch.Tensor
    views: DetectorViews
    parts: tuple[int, int]
    measurement: Measurement
    sums: torch.Tensor
    largest: torch.Tensor

    @property
    def of_step(self) -> int:
        """Views of the whole step, over whose rays the misfit is a mean."""
        return self.chosen.shape[1]

    @property
    def area(self) -> int:
        """Pixels of a view."""
        return self.views.rows * self.views.columns // math.prod(self.parts)

    def gradient(self) -> torch.Tensor:
        """Room for the gradient, laid out for the projection's adjoint."""
        room, beyond = gradient_room(self.views)
        return self.raw.new_empty((len(self.views) * room + beyond) * spread(max(1, self.measurement.curves)))

    def spectrum(self) -> tuple[torch.Tensor, torch.Tensor, int]:
        """Log weights, attenuation and number of the nodes; without nodes two tensors that are not read."""
        log_weights, attenuation = self.measurement.nodes or (self.raw, self.raw)
        return log_weights, attenuation, 0 if self.measurement.nodes is None else len(log_weights)

    def filters(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Filters of the pixels and their attenuation at the nodes; without them two tensors that are not read."""
        behind, by_node = self.measurement.behind, self.measurement.by_node
        return self.raw if behind is None else behind, self.raw if by_node is None else by_node

    def blocks(self) -> tuple[int, int]:
        """The grid of a kernel over the pixels of each view."""
        return triton.cdiv(self.area, PIXELS_A_PROGRAM), len(self.views)

    def gradient_blocks(self) -> tuple[int, int]:
        """The grid of a kernel over the room for the gradient, which has a place for each ray."""
        return triton.cdiv(sum(gradient_room(self.views)), PIXELS_A_PROGRAM), len(self.views)


@triton.jit
def _log_weight(log_weights, k, filter, by_node, FILTERED: tl.constexpr):
    """Of a node, behind the pixel's filter."""
    weight = tl.load(log_weights + k)
    if FILTERED:
        weight -= filter * tl.load(by_node + k)
    return weight


@triton.jit
def _one_curve(a, log_weights, attenuation, nodes, filter, by_node, FILTERED: tl.constexpr):
    """P and its derivative by the areal density of the first material."""
    largest = tl.full(a.shape, float("-inf"), tl.float32)
    for k in range(nodes):
        weight = _log_weight(log_weights, k, filter, by_node, FILTERED)
        largest = tl.maximum(largest, weight - a * tl.load(attenuation + k))
    total, slope = tl.zeros_like(a), tl.zeros_like(a)
    for k in range(nodes):
        b = tl.load(attenuation + k)
        term = tl.exp(_log_weight(log_weights, k, filter, by_node, FILTERED) - a * b - largest)
        total += term
        slope += term * b
    return -(largest + tl.log(total)), slope / total


@triton.jit
def _beer_lambert(a0, a1, a2, log_weights, attenuation, nodes, filter, by_node, FILTERED: tl.constexpr):
    """P and its derivatives by the three areal densities."""
    largest = tl.full(a0.shape, float("-inf"), tl.float32)
    for k in range(nodes):
        b0, b1, b2 = (
            tl.load(attenuation + 3 * k),
            tl.load(attenuation + 3 * k + 1),
            tl.load(attenuation + 3 * k + 2),
        )
        weight = _log_weight(log_weights, k, filter, by_node, FILTERED)
        largest = tl.maximum(largest, weight - (a0 * b0 + a1 * b1 + a2 * b2))
    total, d0, d1, d2 = tl.zeros_like(a0), tl.zeros_like(a0), tl.zeros_like(a0), tl.zeros_like(a0)
    for k in range(nodes):
        b0, b1, b2 = (
            tl.load(attenuation + 3 * k),
            tl.load(attenuation + 3 * k + 1),
            tl.load(attenuation + 3 * k + 2),
        )
        weight = _log_weight(log_weights, k, filter, by_node, FILTERED)
        term = tl.exp(weight - (a0 * b0 + a1 * b1 + a2 * b2) - largest)
        total += term
        d0 += term * b0
        d1 += term * b1
        d2 += term * b2
    return -(largest + tl.log(total)), d0 / total, d1 / total, d2 / total


@triton.jit
def _is_held_out(view, pixel, held_out):
    """The pseudo-random choice of ``Rays``: a multiplicative hash (Knuth) of view and pixel."""
    mixed = (pixel.to(tl.int64) * 2654435761 + (view * 40503 + 12345)) & 0xFFFFFFFF
    mixed = ((mixed ^ (mixed >> 15)) * 2246822519) & 0xFFFFFFFF
    return (mixed >> 16) < held_out


@triton.jit
def sharp_projection(
    raw, at, factor, log_weights, attenuation, nodes, behind, by_node, pixel, area,
    CURVES: tl.constexpr, FILTERED: tl.constexpr,
):  # fmt: skip
    """Largest number of the splat's image, P of the rays through pixels' centres, and its derivatives."""
    filter, alone = 0.0, 0.0
    if FILTERED:
        filter, alone = tl.load(behind + pixel), tl.load(behind + area + pixel)
    if CURVES == 0:
        a0 = tl.load(raw + at)
        one = tl.full(a0.shape, 1.0, tl.float32)
        return a0, a0 * factor, one, one, one
    if CURVES == 1:
        a0 = tl.load(raw + at)
        predicted, d0 = _one_curve(a0 * factor, log_weights, attenuation, nodes, filter, by_node, FILTERED)
        if FILTERED:
            predicted -= alone
        return a0, predicted, d0, d0, d0
    a0, a1, a2, _ = load_four(raw + 4 * at)
    most = tl.maximum(a0, tl.maximum(a1, a2))
    predicted, d0, d1, d2 = _beer_lambert(
        a0 * factor, a1 * factor, a2 * factor, log_weights, attenuation, nodes, filter, by_node, FILTERED
    )
    if FILTERED:
        predicted -= alone
    return most, predicted, d0, d1, d2


@triton.jit
def ray_misfit(
    predicted, projections, totals, chosen, sums, k, pixel, inside, area, of_step, noise, held_out, corner, behind,
    HUBER: tl.constexpr, FILTERED: tl.constexpr,
):  # fmt: skip
    """Gradient of the misfit by the projection; what there is to read of it is added to ``sums``."""
    view, slot = tl.load(chosen + k).to(tl.int64), tl.load(chosen + of_step + k).to(tl.int64)
    value = tl.load(projections + slot * area + pixel, mask=inside, other=float("nan"))
    usable = tl.abs(value) < float("inf")
    value = tl.where(usable, value, 0.0)
    # The exponential of an opaque ray may be infinite, which is not to be multiplied by zero.
    depth = value
    if FILTERED:
        depth += tl.load(behind + 2 * area + pixel, mask=inside, other=0.0)
    variance = tl.where(noise > 0, tl.exp(depth) * noise, 0.0)
    weight = tl.where(usable, tl.math.rsqrt(1.0 + variance), 0.0)
    aside = _is_held_out(view, pixel, held_out)
    residual = predicted - value
    scaled = tl.abs(residual) * weight
    loss, slope = scaled, weight
    if HUBER:
        near = scaled < corner
        loss = tl.where(near, scaled * scaled / (2 * corner), scaled - 0.5 * corner)
        slope = tl.where(near, weight * scaled / corner, weight)
    total = tl.zeros([], tl.float32)
    for j in range(of_step):
        total += tl.load(totals + tl.load(chosen + j).to(tl.int64))
    by_total = 1.0 / tl.maximum(total, 1e-12)
    loss = tl.where(weight > 0, loss, 0.0)
    tl.atomic_add(sums, (tl.sum(tl.where(aside, 0.0, loss), 0) * by_total).to(tl.float64), sem="relaxed")
    tl.atomic_add(sums + 1, tl.sum(tl.where(aside, loss, 0.0), 0).to(tl.float64), sem="relaxed")
    tl.atomic_add(sums + 2, tl.sum(tl.where(aside, weight, 0.0), 0).to(tl.float64), sem="relaxed")
    slope = tl.where(residual > 0, slope, tl.where(residual < 0, -slope, 0.0))
    return tl.where(aside | (weight == 0), 0.0, slope * by_total)


@triton.jit
def store_gradients(pixels, to, slope, d0, d1, d2, live, CURVES: tl.constexpr):
    """Gradients by the line integrals of the channels, in the layout of triton_image."""
    if CURVES < 3:
        tl.store(pixels + to, slope * d0, mask=live)
    else:
        store_four(pixels + 4 * to, slope * d0, slope * d1, slope * d2, tl.zeros_like(slope), live)


@triton.jit(do_not_specialize=SIZES)
def _misfit_kernel(
    raw, pixels, table, chosen, projections, totals, log_weights, attenuation, behind, by_node, sums, largest,
    area, columns, room, beyond, many, of_step, nodes, noise, held_out, corner, areal_scale,
    CURVES: tl.constexpr, FILTERED: tl.constexpr, CONE: tl.constexpr, HUBER: tl.constexpr, FOLD: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    k = tl.program_id(1).to(tl.int64)
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < area
    live = pixel < room + tl.where(k == many - 1, beyond, 0)
    factor = pixel_factor(table, k, pixel, columns, CONE) * areal_scale
    within = tl.minimum(pixel, area - 1)
    most, predicted, d0, d1, d2 = sharp_projection(
        raw, k * area + within, factor, log_weights, attenuation, nodes, behind, by_node, within, area,
        CURVES, FILTERED,
    )  # fmt: skip
    tl.atomic_max(largest, tl.max(most, 0), sem="relaxed")
    slope = ray_misfit(
        predicted, projections, totals, chosen, sums, k, pixel, inside, area, of_step, noise, held_out,
        corner, behind, HUBER, FILTERED,
    )  # fmt: skip
    to = k * room + place(pixel, columns, FOLD)
    store_gradients(pixels, to, slope * factor, d0, d1, d2, live, CURVES)


def misfit_gradient(splat: Splat) -> torch.Tensor:
    """The gradient of the misfit of one ray a pixel, as `Splat.gradient` lays it out."""
    measurement, pixels = splat.measurement, splat.gradient()
    log_weights, attenuation, nodes = splat.spectrum()
    with on_device(splat.raw):
        _misfit_kernel[splat.gradient_blocks()](
            splat.raw, pixels, splat.table, splat.chosen, measurement.projections, measurement.totals,
            log_weights, attenuation, *splat.filters(), splat.sums, splat.largest,
            splat.area, splat.views.columns, *gradient_room(splat.views), len(splat.views),
            splat.of_step, nodes, measurement.noise, measurement.held_out, measurement.corner, measurement.areal_scale,
            CURVES=measurement.curves, FILTERED=measurement.behind is not None,
            CONE=splat.views.cone, HUBER=measurement.corner > 0,
            FOLD=folded(splat.views), BLOCK=PIXELS_A_PROGRAM, num_warps=4,
        )  # fmt: skip
    return pixels
