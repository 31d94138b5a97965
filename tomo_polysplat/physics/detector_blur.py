r"""The blur of the detector: a pixel sees more than the ray through its centre.

A pixel averages over its own area, focal spot and scintillator spread the light further, and simulators blur by their
interpolation. The model describes all of this as one blur of the projections:

.. math:: P'_k = \sum_j A_{kj} P_j

with A the blur of three taps (v/2, 1-v, v/2) along rows and along columns, whose variance is v squared pixels; the
image is continued by its border. Averaging over a pixel's own area alone has v = 1/12.

Light is spread before the logarithm, and -log of mixed light is less than this:

.. math:: P'_k = -\log \sum_j A_{kj} \exp(-P_j)

So it is where the rays show that pixels average light. Elsewhere the blur is that of P: mixed light can hide
any amount of metal at the edges of opaque metal, and a model of thin rays that mixes it adds metal where that mends
another error of its edges (docs/decisions/detector_blur.md).
"""

from __future__ import annotations

from typing import Any

import torch

from tomo_polysplat.kernels.device import is_for_compiled
from tomo_polysplat.kernels.step.mixed_light import MOST_BESIDE

__all__ = ["LARGEST_BLUR", "blurred", "blurred_light"]

# Three taps make no wider blur without a dip in their middle.
LARGEST_BLUR = 0.6


def blurred(projections: torch.Tensor, variance: torch.Tensor) -> torch.Tensor:
    """Projections as pixels of some extent see them.

    Parameters
    ----------
    projections : (views, rows, columns) tensor
        -log(I/I0) of the rays through the pixels' centres.
    variance : (1,) tensor
        Of the blur along rows and along columns, in squared pixels, from 0 to `LARGEST_BLUR`.

    Returns
    -------
    (views, rows, columns) tensor
        Differentiable by both. An axis of one pixel is not blurred.
    """
    if is_for_compiled(projections):
        return _Blurred.apply(projections, variance)
    beside, same = 0.5 * variance, 1 - variance
    for axis in (1, 2):
        if projections.shape[axis] > 1:
            before, after = _neighbours(projections, axis)
            projections = same * projections + beside * (before + after)
    return projections


def blurred_light(projections: torch.Tensor, variance: torch.Tensor) -> torch.Tensor:
    """-log of light as it arrives where the detector spreads it.

    Parameters
    ----------
    projections : (views, rows, columns) tensor
        -log of the light of each pixel.
    variance : (1,) tensor
        Of the blur along rows and along columns, in squared pixels, from 0 to `LARGEST_BLUR`.

    Returns
    -------
    (views, rows, columns) tensor
        Differentiable by both. An axis of one pixel is not blurred.
    """
    for axis in (1, 2):
        if projections.shape[axis] > 1:
            # Light beside a pixel, in that of its own: rounding then leaves a blur of 0 as it is.
            before, after = (
                (projections - one).clamp(max=MOST_BESIDE).exp() for one in _neighbours(projections, axis)
            )
            projections = projections - torch.log1p(0.5 * variance * (before + after - 2))
    return projections


def _neighbours(projections: torch.Tensor, axis: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The pixel before each one along an axis, and the one behind; beyond the border lies the border's own again."""
    count = projections.shape[axis]
    first, last = projections.narrow(axis, 0, 1), projections.narrow(axis, count - 1, 1)
    wide = torch.cat([first, projections, last], dim=axis)
    return wide.narrow(axis, 0, count), wide.narrow(axis, 2, count)


class _Blurred(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, projections: torch.Tensor, variance: torch.Tensor) -> torch.Tensor:
        from tomo_polysplat.kernels.step.numba_blur import blur

        ctx.save_for_backward(projections, variance)
        return torch.from_numpy(blur(projections.detach().numpy(), variance.item())[0])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        from tomo_polysplat.kernels.step.numba_blur import blur

        projections, variance = ctx.saved_tensors
        # The blur is its own adjoint.
        pulled, slope = blur(gradient.numpy(), variance.item(), projections.detach().numpy())
        return torch.from_numpy(pulled), variance.new_full((1,), slope)
