"""The projection of Gaussians on CUDA, as a differentiable torch operation. README.md derives the formulas.

Forward and backward are deterministic; see triton_forward.py and triton_backward.py. Gaussians that are near
in space should be near in the list (``kernels.spatial_order``): that changes the speed, not the result.
"""

from __future__ import annotations

import torch

from tomo_polysplat.kernels.project.triton_backward import sum_moments
from tomo_polysplat.kernels.project.triton_forward import gather_image
from tomo_polysplat.kernels.project.triton_pull_back import pull_back
from tomo_polysplat.kernels.project.triton_setup import footprints, view_table
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
    """Line integrals of weighted Gaussians, without the factor of the pixel; arguments as for the reference.

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
        table = view_table(views, position.device)
        record, ellipse, boxes, skipped = footprints(position, scale, rotation, weight, views, table, cutoff)
        image = gather_image(record, ellipse, boxes, len(weight), views, cutoff)
        ctx.save_for_backward(position, scale, rotation, weight, table, record, ellipse)
        ctx.views, ctx.cutoff = views, cutoff
        ctx.mark_non_differentiable(skipped)
        return image, skipped

    @staticmethod
    def backward(ctx, grad_image, _):
        position, scale, rotation, weight, table, record, ellipse = ctx.saved_tensors
        if not record.numel():
            return (*map(torch.zeros_like, (position, scale, rotation, weight)), None, None)
        moments = sum_moments(record, ellipse, grad_image, ctx.views, ctx.cutoff)
        grads = pull_back(position, scale, rotation, weight, table, ctx.views, record, ellipse, moments)
        return (*grads, None, None)
