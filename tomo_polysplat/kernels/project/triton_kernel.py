"""The projection of Gaussians on CUDA, as a differentiable torch operation. README.md derives the formulas.

The image repeats to rounding from run to run, the gradients of one image to the bit; see triton_forward.py and
triton_backward.py. Gaussians that are near in space should be near in the list (``kernels.spatial_order``):
that changes the speed, not the result.
"""

from __future__ import annotations

import torch

from tomo_polysplat.kernels.project.triton_backward import sum_moments
from tomo_polysplat.kernels.project.triton_forward import splat
from tomo_polysplat.kernels.project.triton_image import finish_image, lay_out_gradient
from tomo_polysplat.kernels.project.triton_pull_back import pull_back
from tomo_polysplat.kernels.project.triton_setup import footprints
from tomo_polysplat.kernels.triton_maths import require_scene
from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["project"]


def project(
    position: torch.Tensor,
    scale: torch.Tensor,
    rotation: torch.Tensor,
    weight: torch.Tensor,
    views: DetectorViews,
    cutoff: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Line integrals of weighted Gaussians; arguments as for the reference.

    Returns
    -------
    image : (channels, views, rows, columns) float32 tensor
    skipped : 0-dim int64 tensor
        Pairs of a Gaussian and a view left out; on the device, so that reading it is the caller's choice.

    Raises
    ------
    ValueError
        If a tensor is not float32 or there are more than four channels.
    """
    require_scene(position, scale, rotation, weight)
    return _Project.apply(position, scale, rotation, weight, views, cutoff)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, position, scale, rotation, weight, views, cutoff):
        position, scale, rotation, weight = (
            t.detach().contiguous() for t in (position, scale, rotation, weight)
        )
        table = views.table(position.device)
        skipped = torch.zeros((), dtype=torch.int64, device=position.device)
        record = footprints(position, scale, rotation, weight, views, table, cutoff, skipped)
        image = finish_image(splat(record, len(weight), views, cutoff), table, len(weight), views)
        ctx.save_for_backward(position, scale, rotation, weight, table, record)
        ctx.views = views
        ctx.mark_non_differentiable(skipped)
        return image, skipped

    @staticmethod
    def backward(ctx, grad_image, _):
        position, scale, rotation, weight, table, record = ctx.saved_tensors
        if not (record.numel() and grad_image.numel()):
            return (*map(torch.zeros_like, (position, scale, rotation, weight)), None, None)
        pixels = lay_out_gradient(grad_image, table, ctx.views)
        moments = sum_moments(record, pixels, len(grad_image), ctx.views)
        grads = pull_back(position, scale, rotation, weight, table, ctx.views, moments)
        return (*grads, None, None)
