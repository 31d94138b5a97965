"""The projection as a differentiable torch operation, whichever implementation does the work."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from tomo_polysplat.kernels.project import reference
from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["project"]


def project(
    position: torch.Tensor,
    scale: torch.Tensor,
    rotation: torch.Tensor,
    weight: torch.Tensor,
    views: DetectorViews,
    *,
    kernel: str,
    cutoff: float,
    vectors: torch.Tensor | None = None,
) -> tuple[torch.Tensor, int]:
    """Line integrals of weighted Gaussians over every pixel; arguments and results as in ``reference.project``.

    ``kernel`` is ``"reference"``, ``"numba"`` or ``"triton"``; the compiled ones take float32 only. ``vectors``,
    (views, 4, 3) float64 on the CPU, take the place of ``views.vectors`` and get a gradient.
    """
    if vectors is not None:
        views = views.moved(vectors.detach().numpy())
    if kernel == "reference":
        return reference.project(position, scale, rotation, weight, views, cutoff, vectors)
    skipped: Any  # on the device, for the triton kernel: reading it would wait for the device
    if kernel == "triton":
        from tomo_polysplat.kernels.project import triton_kernel

        image, skipped = triton_kernel.project(position, scale, rotation, weight, views, cutoff, vectors)
        return image, skipped
    factor = math.sqrt(2 * math.pi) * views.ray_lengths(position.device, position.dtype, vectors)
    # Where it is not differentiated there is no image without it.
    inside = factor.numpy() if vectors is None else None
    image, skipped = _NumbaProject.apply(position, scale, rotation, weight, views, cutoff, vectors, inside)
    return (image * factor if vectors is not None else image), skipped


class _NumbaProject(torch.autograd.Function):
    @staticmethod
    def forward(ctx, position, scale, rotation, weight, views, cutoff, vectors, factor):
        from tomo_polysplat.kernels.project import numba_kernel

        arrays = [t.detach().contiguous().numpy() for t in (position, scale, rotation, weight)]
        position, scale, rotation, weight = arrays
        image, skipped, state = numba_kernel.forward(position, scale, rotation, weight, views, cutoff)
        ctx.arrays, ctx.views, ctx.cutoff, ctx.state, ctx.factor = arrays, views, cutoff, state, factor
        if factor is not None:
            image = np.multiply(image, factor, out=torch.empty(image.shape, dtype=torch.float32).numpy())
        return torch.from_numpy(image), skipped

    @staticmethod
    def backward(ctx, grad_image, _):
        from tomo_polysplat.kernels.project import numba_kernel

        position, scale, rotation, weight = ctx.arrays
        gradient = grad_image.numpy()
        grads = numba_kernel.backward(
            position, scale, rotation, weight, ctx.views, ctx.cutoff, ctx.state,
            gradient if ctx.factor is None else gradient * ctx.factor, of_views=ctx.needs_input_grad[6],
        )  # fmt: skip
        of_views = torch.from_numpy(grads[4]) if ctx.needs_input_grad[6] else None
        return (*map(torch.from_numpy, grads[:4]), None, None, of_views, None)
