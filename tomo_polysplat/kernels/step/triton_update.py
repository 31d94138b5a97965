"""Adam's update of all parameters of Gaussians, from the gradients of what was drawn, in a few CUDA kernels.

The adjoint of triton_activate.py and the optimiser (Kingma and Ba 2015, arXiv:1412.6980) in one: a lane reads
all of a Gaussian and writes it once. The material numbers of the groups, which many Gaussians share, are added
up atomically and the blur too, follow in kernels of their own.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.step.triton_activate import material, mixture
from tomo_polysplat.kernels.triton_maths import SIZES, dot, on_device

__all__ = ["FIRST_DECAY", "SECOND_DECAY", "WHOLE", "WHOLE_OF_BLUR", "Bounds", "update", "update_shared"]

FIRST_DECAY, SECOND_DECAY = 0.9, 0.999
_KEEP_FIRST, _KEEP_SECOND = tl.constexpr(FIRST_DECAY), tl.constexpr(SECOND_DECAY)
# Gradients of what many share are added up in whole numbers of 1 / WHOLE, in any order to the same bits.
WHOLE = tl.constexpr(2.0**50)
# The blur's can be thousands of times as steep, as far as projections reach.
WHOLE_OF_BLUR = tl.constexpr(2.0**40)
_BLOCK = 128


@dataclass(frozen=True)
class Bounds:
    """What the update keeps to: the ends of log scale and material number, the widest blur, Adam's epsilon."""

    log_scale: tuple[float, float]
    material: tuple[float, float]
    blur: float
    epsilon: float


@triton.jit
def _adam(parameter, first, second, at, live, gradient, rate, root, epsilon):
    """The parameter after a step, both moments stored; ``rate`` and ``root`` hold the bias corrections."""
    m = tl.load(first + at, mask=live, other=0.0)
    m += (1 - _KEEP_FIRST) * (gradient - m)
    v = _KEEP_SECOND * tl.load(second + at, mask=live, other=0.0) + (1 - _KEEP_SECOND) * gradient * gradient
    tl.store(first + at, m, mask=live)
    tl.store(second + at, v, mask=live)
    return tl.load(parameter + at, mask=live, other=0.0) - rate * m / (tl.sqrt(v) / root + epsilon)


@triton.jit
def _kept(value, low, high):
    # A number that is not one must stay so: it ends the run.
    return tl.clamp(value, low, high, propagate_nan=tl.PropagateNan.ALL)


@triton.jit
def _both(a, b, at, live):
    return tl.load(a + at, mask=live, other=0.0) + tl.load(b + at, mask=live, other=0.0)


@triton.jit
def _material_gradients(grad_weight, grad_output, own, shared, group, curves, height, n, count, live):
    """Group, and the gradients of attenuation and material number."""
    member, u = material(own, shared, group, n, live)
    m0, m1, m2, total = mixture(u, curves)
    seen = tl.load(grad_output + n, mask=live, other=0.0)
    g0 = tl.load(grad_weight + n, mask=live, other=0.0) + seen * tl.load(curves + 3)
    g1 = tl.load(grad_weight + count + n, mask=live, other=0.0) + seen * tl.load(curves + 4)
    g2 = tl.load(grad_weight + 2 * count + n, mask=live, other=0.0) + seen * tl.load(curves + 5)
    d0, d1, d2 = -2 * (1 - u), 2 - 4 * u, 2 * u
    by_height = dot(g0, g1, g2, m0, m1, m2) / total
    slope = dot(tl.load(curves), tl.load(curves + 1), tl.load(curves + 2), d0, d1, d2)
    return member, by_height, height / total * (dot(g0, g1, g2, d0, d1, d2) - by_height * slope)


@triton.jit
def _add_to_groups(grad_shared, member, value):
    """Sums of ``value`` by group; neighbours mostly share one, which is then added at once."""
    value = (value.to(tl.float64) * WHOLE).to(tl.int64)
    largest = tl.max(member, 0)
    if largest > 0:
        together = member == largest
        tl.atomic_add(grad_shared + largest, tl.sum(tl.where(together, value, 0), 0), sem="relaxed")
        tl.atomic_add(grad_shared + member, value, mask=(member > 0) & ~together, sem="relaxed")


@triton.jit(do_not_specialize=SIZES)
def _update_kernel(
    position, log_scale, rotation, attenuation, own, shared, group,
    position_1, log_scale_1, rotation_1, attenuation_1, own_1,
    position_2, log_scale_2, rotation_2, attenuation_2, own_2,
    scale, curves, grad_position, grad_scale, grad_rotation, grad_weight,
    volume_position, volume_scale, volume_rotation, grad_output, grad_shared, pull, rates, control, count,
    low, high, least_u, most_u, epsilon,
    DIMS: tl.constexpr, CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = n < count
    share, root = tl.load(control).to(tl.float32), tl.load(control + 1).to(tl.float32)
    square = tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(3):
        at = n * 3 + k
        gradient = _both(grad_position, volume_position, at, live)
        square += gradient * gradient
        rate = tl.load(rates) * share
        p = _adam(position, position_1, position_2, at, live, gradient, rate, root, epsilon)
        tl.store(position + at, p, mask=live)
    tl.store(pull + n, tl.load(pull + n, mask=live, other=0.0) + tl.sqrt(square), mask=live)
    for k in tl.static_range(DIMS):
        at = n * DIMS + k
        gradient = _both(grad_scale, volume_scale, n * 3 + k, live)
        gradient *= tl.load(scale + n * 3 + k, mask=live, other=0.0)
        rate = tl.load(rates + 1) * share
        p = _adam(log_scale, log_scale_1, log_scale_2, at, live, gradient, rate, root, epsilon)
        tl.store(log_scale + at, _kept(p, low, high), mask=live)
    turning = tl.load(control + 3).to(tl.float32)
    for k in tl.static_range(4):
        at = n * 4 + k
        gradient = _both(grad_rotation, volume_rotation, at, live)
        rate = tl.load(rates + 2) * share * turning
        p = _adam(rotation, rotation_1, rotation_2, at, live, gradient, rate, root, epsilon)
        tl.store(rotation + at, p, mask=live)
    height = tl.load(attenuation + n, mask=live, other=0.0)
    if CHANNELS == 1:
        by_height = _both(grad_weight, grad_output, n, live)
    else:
        member, by_height, by_u = _material_gradients(
            grad_weight, grad_output, own, shared, group, curves, height, n, count, live
        )
        by_u = tl.where(live, by_u, 0.0)
        _add_to_groups(grad_shared, member, by_u)
        rate = tl.load(rates + 4) * share
        u = _adam(own, own_1, own_2, n, live, tl.where(member < 0, by_u, 0.0), rate, root, epsilon)
        tl.store(own + n, _kept(u, least_u, most_u), mask=live)
    rate = tl.load(rates + 3) * share
    p = _adam(attenuation, attenuation_1, attenuation_2, n, live, by_height, rate, root, epsilon)
    tl.store(attenuation + n, _kept(p, 0.0, float("inf")), mask=live)


@triton.jit(do_not_specialize=SIZES)
def _common_kernel(
    parameter, first, second, gradient, rate, control, count, held, low, high, epsilon,
    UNITS: tl.constexpr, FREED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = n < count
    whole = tl.load(gradient + n, mask=live, other=0)
    slope = tl.where(n < held, 0.0, (whole.to(tl.float64) / UNITS).to(tl.float32))
    if FREED:
        slope *= tl.load(control + 2).to(tl.float32)
    share, root = tl.load(control).to(tl.float32), tl.load(control + 1).to(tl.float32)
    p = _adam(parameter, first, second, n, live, slope, tl.load(rate) * share, root, epsilon)
    tl.store(parameter + n, _kept(p, low, high), mask=live)
    tl.store(gradient + n, tl.zeros([BLOCK], tl.int64), mask=live)


def update(
    parameters: dict[str, torch.Tensor],
    group: torch.Tensor,
    moments: dict[str, tuple[torch.Tensor, torch.Tensor]],
    drawn: tuple[torch.Tensor, torch.Tensor | None],
    of_rays: tuple[torch.Tensor, ...],
    of_volume: tuple[torch.Tensor, ...],
    state: tuple[torch.Tensor, ...],
    bounds: Bounds,
) -> None:
    """Change parameters and moments of each Gaussian in place.

    Parameters
    ----------
    parameters : dict
        Those of ``model.Gaussians`` by name, contiguous.
    group : (n,) int64 tensor
    moments : dict of pairs of tensors
    drawn : tuple
        Deviations (n, 3) and the curves given to `activate`.
    of_rays, of_volume : tuple of tensors
        Gradients of position, deviation, rotation and weights, as the projection's and the voxeliser's
        adjoints give them.
    state : tuple of tensors
        Gradients of the shared numbers (groups,), int64, to which those of these Gaussians are added; pull (n,), to
        which the lengths of the gradients by position are added; rates (7,) in the order of the parameters;
        control (4,) float64: the share of the rates over Adam's first bias correction, the root of its second
        one, whether the metals' shared numbers may move, and whether Gaussians may turn.
    bounds : Bounds
    """
    names = ("position", "log_scale", "rotation", "attenuation", "own_material")
    grad_shared, pull, rates, control = state
    (scale, curves), (low, high), (least, most) = drawn, bounds.log_scale, bounds.material
    count = len(group)
    with on_device(group):
        _update_kernel[(triton.cdiv(count, _BLOCK),)](
            *(parameters[k] for k in names), parameters["shared_material"], group,
            *(moments[k][0] for k in names), *(moments[k][1] for k in names),
            scale, scale if curves is None else curves, *of_rays, *of_volume, grad_shared, pull, rates, control,
            count, low, high, least, most, bounds.epsilon,
            DIMS=parameters["log_scale"].shape[1], CHANNELS=1 if curves is None else 3, BLOCK=_BLOCK,
            num_warps=4,
        )  # fmt: skip


def update_shared(
    parameters: dict[str, torch.Tensor],
    moments: dict[str, tuple[torch.Tensor, torch.Tensor]],
    grad_shared: torch.Tensor | None,
    grad_blur: torch.Tensor | None,
    rates: torch.Tensor,
    control: torch.Tensor,
    bounds: Bounds,
) -> None:
    """Change what all Gaussians share, in place, by its gradients, which are left at zero.

    Parameters
    ----------
    parameters, moments, rates, control, bounds
        As for `update`.
    grad_shared, grad_blur : (groups,) and (1,) int64 tensors, or None
        None for what is not fitted.
    """
    # The soft matter's number is held, and the metals' until the control lets them go.
    common = [] if grad_shared is None else [("shared_material", grad_shared, WHOLE, 5, 1, *bounds.material)]
    common += [] if grad_blur is None else [("blur", grad_blur, WHOLE_OF_BLUR, 6, 0, 0.0, bounds.blur)]
    for name, gradient, units, k, held, low, high in common:
        parameter = parameters[name]
        with on_device(parameter):
            _common_kernel[(triton.cdiv(len(parameter), _BLOCK),)](
                parameter, *moments[name], gradient, rates[k:], control, len(parameter), held, low, high,
                bounds.epsilon, UNITS=units.value, FREED=name == "shared_material", BLOCK=_BLOCK, num_warps=4,
            )  # fmt: skip
