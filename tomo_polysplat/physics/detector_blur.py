r"""What a detector does to an image: light that belongs to a pixel is counted in its neighbours.

A pixel averages over its own area, and focal spot and scintillator spread light further. All of it acts on
intensities, before the logarithm:

.. math:: P'_k = -\log \sum_j A_{kj} e^{-P_j}

with A the blur of three taps (v/2, 1-v, v/2) along rows and along columns, whose variance is v squared pixels; the
image is continued by its border. Averaging over a pixel's own area alone has v = 1/12.
"""

from __future__ import annotations

import torch

__all__ = ["LARGEST_BLUR", "blurred", "describe_blur"]

# Three taps make no wider blur without a dip in their middle.
LARGEST_BLUR = 0.6


def blurred(projections: torch.Tensor, variance: torch.Tensor) -> torch.Tensor:
    """Projections as a blurring detector sees them.

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
    beside, same = 0.5 * variance, 1 - variance
    weights = torch.stack([beside, same, beside])[..., None, None]
    for axis in (1, 2):
        count = projections.shape[axis]
        if count > 1:
            first, last = projections.narrow(axis, 0, 1), projections.narrow(axis, count - 1, 1)
            wide = torch.cat([first, projections, last], dim=axis)
            taps = torch.stack([wide.narrow(axis, k, count) for k in range(3)])
            # The brightest ray is taken out of the sum: that of opaque ones would be zero.
            brightest = taps.detach().amin(dim=0)
            passed = (weights * torch.exp(brightest - taps)).sum(dim=0)
            projections = brightest - torch.log(passed.clamp(min=torch.finfo(passed.dtype).tiny))
    return projections


def describe_blur(variance: torch.Tensor, *, fitted: bool) -> str:
    """What a reconstruction took for the blur, in words; the ``variance``, (1,), in squared pixels."""
    value = float(variance)
    if not (fitted or value):
        return "none: rays are infinitely thin"
    return f"variance of {value:.3f} squared pixels, {'fitted' if fitted else 'held as asked for'}"
