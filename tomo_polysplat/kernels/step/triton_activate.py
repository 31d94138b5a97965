"""From the parameters of Gaussians to what the CUDA kernels draw: deviations and the weight of every channel.

The same as ``Gaussians.scale`` and ``Gaussians.weights``, in one kernel; triton_update.py has its adjoint.
"""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.triton_maths import SIZES, dot, on_device

__all__ = ["activate", "material", "mixture"]

_BLOCK = 128


@triton.jit
def material(own, shared, group, n, live):
    """Group and material number u of the Gaussians ``n``."""
    member = tl.load(group + n, mask=live, other=-1)
    common = tl.load(shared + tl.maximum(member, 0), mask=live, other=0.0)
    return member, tl.where(member < 0, tl.load(own + n, mask=live, other=0.0), common)


@triton.jit
def mixture(u, curves):
    """Shares of the three curves at u, and the attenuation of their mixture at the reference energy."""
    m0, m1, m2 = (1 - u) * (1 - u), 2 * u * (1 - u), u * u
    return m0, m1, m2, dot(tl.load(curves), tl.load(curves + 1), tl.load(curves + 2), m0, m1, m2)


@triton.jit(do_not_specialize=SIZES)
def _activate_kernel(
    log_scale, attenuation, own, shared, group, curves, scale, weight, output, count,
    DIMS: tl.constexpr, CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = n < count
    for k in tl.static_range(3):
        if k < DIMS:
            tl.store(scale + n * 3 + k, tl.exp(tl.load(log_scale + n * DIMS + k, mask=live)), mask=live)
        else:
            tl.store(scale + n * 3 + k, float("inf"), mask=live)
    height = tl.load(attenuation + n, mask=live, other=0.0)
    if CHANNELS == 1:
        tl.store(weight + n, height, mask=live)
        tl.store(output + n, height, mask=live)
    else:
        _, u = material(own, shared, group, n, live)
        m0, m1, m2, total = mixture(u, curves)
        height = height / total
        tl.store(weight + n, m0 * height, mask=live)
        tl.store(weight + count + n, m1 * height, mask=live)
        tl.store(weight + 2 * count + n, m2 * height, mask=live)
        seen = dot(tl.load(curves + 3), tl.load(curves + 4), tl.load(curves + 5), m0, m1, m2)
        tl.store(output + n, seen * height, mask=live)


def activate(
    log_scale: torch.Tensor,
    attenuation: torch.Tensor,
    own: torch.Tensor,
    shared: torch.Tensor,
    group: torch.Tensor,
    curves: torch.Tensor | None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Deviations (n, 3), weights of the channels (3 or 1, n) and attenuation in the volume (1, n).

    Parameters
    ----------
    log_scale, attenuation, own, shared, group : tensors
        As in ``model.Gaussians``, contiguous.
    curves : (6,) float32 tensor or None
        Attenuation of the three curves at the Gaussians' energy, then at the volume's, each over that of the
        first at the Gaussians' energy; None for a monochromatic model.
    """
    count, channels = len(attenuation), 1 if curves is None else 3
    scale = log_scale.new_empty((count, 3))
    weight, output = attenuation.new_empty((channels, count)), attenuation.new_empty((1, count))
    with on_device(log_scale):
        _activate_kernel[(triton.cdiv(count, _BLOCK),)](
            log_scale, attenuation, own, shared, group, attenuation if curves is None else curves,
            scale, weight, output, count, DIMS=log_scale.shape[1], CHANNELS=channels, BLOCK=_BLOCK,
            num_warps=4,
        )  # fmt: skip
    return scale, weight, output
