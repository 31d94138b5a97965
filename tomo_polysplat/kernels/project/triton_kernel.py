"""The projection of Gaussians on CUDA, as a differentiable torch operation. README.md derives the formulas.

The image repeats to rounding from run to run, the gradients of one image to the bit; see triton_forward.py and
triton_backward.py. Gaussians that are near in space should be near in the list (``kernels.spatial_order``):
that changes the speed, not the result.
"""

from __future__ import annotations

import torch

from tomo_polysplat.kernels.portions import portions
from tomo_polysplat.kernels.project.triton_backward import sum_moments
from tomo_polysplat.kernels.project.triton_forward import splat
from tomo_polysplat.kernels.project.triton_image import finish_image, lay_out_gradient, spread
from tomo_polysplat.kernels.project.triton_pull_back import pull_back
from tomo_polysplat.kernels.project.triton_setup import footprints
from tomo_polysplat.kernels.triton_maths import require_scene
from tomo_polysplat.kernels.views import DetectorViews, length_gradient

__all__ = ["project"]


def project(
    position: torch.Tensor,
    scale: torch.Tensor,
    rotation: torch.Tensor,
    weight: torch.Tensor,
    views: DetectorViews,
    cutoff: float,
    vectors: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Line integrals of weighted Gaussians; arguments as for the reference, ``vectors`` on the CPU.

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
    return _Project.apply(position, scale, rotation, weight, views, cutoff, vectors)


def _image(
    scene: tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor],
    views: DetectorViews,
    cutoff: float,
    skipped: torch.Tensor,
) -> torch.Tensor:
    """Line integrals of a cloud of any size, a portion after the other."""
    position, scale, rotation, weight = scene
    table, channels = views.table(position.device), len(weight)
    image = position.new_zeros((len(views), views.rows, views.columns, spread(channels)))
    for some in portions(len(position), len(views)):
        drawn = position[some], scale[some], rotation[some], weight[:, some].contiguous()
        record = footprints(*drawn, views, table, cutoff, skipped)
        splat(record, channels, views, cutoff, image=image)
        del record
    return finish_image(image, table, channels, views)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, position, scale, rotation, weight, views, cutoff, vectors):
        position, scale, rotation, weight = (
            t.detach().contiguous() for t in (position, scale, rotation, weight)
        )
        skipped = torch.zeros((), dtype=torch.int64, device=position.device)
        ctx.mark_non_differentiable(skipped)
        scene = (position, scale, rotation, weight)
        if not any(ctx.needs_input_grad):
            return _image(scene, views, cutoff, skipped), skipped
        table, channels = views.table(position.device), len(weight)
        record = footprints(*scene, views, table, cutoff, skipped)
        image = finish_image(splat(record, channels, views, cutoff), table, channels, views)
        # The image is read again only for what the factor of its pixels adds to the gradient of the vectors.
        kept = image if ctx.needs_input_grad[6] else None
        ctx.save_for_backward(*scene, table, record, kept)
        ctx.views = views
        return image, skipped

    @staticmethod
    def backward(ctx, grad_image, _):
        position, scale, rotation, weight, table, record, image = ctx.saved_tensors
        of_views = ctx.needs_input_grad[6]
        if not (record.numel() and grad_image.numel()):
            nothing = torch.zeros((len(ctx.views), 4, 3), dtype=torch.float64) if of_views else None
            return (*map(torch.zeros_like, (position, scale, rotation, weight)), None, None, nothing)
        pixels = lay_out_gradient(grad_image, table, ctx.views)
        moments = sum_moments(record, pixels, len(grad_image), ctx.views)
        scene = (position, scale, rotation, weight)
        if not of_views:
            return (*pull_back(*scene, table, ctx.views, moments), None, None, None)
        *grads, of_vectors = pull_back(*scene, table, ctx.views, moments, of_views=True)
        of_vectors = of_vectors + length_gradient((grad_image * image).sum(dim=0), ctx.views)
        return (*grads, None, None, of_vectors.cpu())
