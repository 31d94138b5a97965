"""Gaussians sampled at voxel centres on CUDA, as a differentiable torch operation.

README.md derives the formulas. The volume repeats to rounding from run to run, the gradients of one volume to
the bit; see triton_forward.py and triton_backward.py. Gaussians that are near in space should be near in the
list (``kernels.spatial_order``): that changes the speed, not the result.
"""

from __future__ import annotations

import torch

from tomo_polysplat.kernels.triton_maths import require_scene
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.kernels.voxelise.triton_backward import pull_back, sum_moments
from tomo_polysplat.kernels.voxelise.triton_forward import splat
from tomo_polysplat.kernels.voxelise.triton_setup import box_table, ellipsoids

__all__ = ["voxelise"]


def voxelise(
    position: torch.Tensor,
    scale: torch.Tensor,
    rotation: torch.Tensor,
    weight: torch.Tensor,
    box: VoxelBox,
    cutoff: float,
) -> torch.Tensor:
    """Sum of weighted Gaussians at the voxel centres; arguments as for the reference.

    Returns
    -------
    volume : (channels, nz, ny, nx) float32 tensor

    Raises
    ------
    ValueError
        If a tensor is not float32 or there are more than four channels.
    """
    require_scene(position, scale, rotation, weight)
    return _Voxelise.apply(position, scale, rotation, weight, box, cutoff)


class _Voxelise(torch.autograd.Function):
    @staticmethod
    def forward(ctx, position, scale, rotation, weight, box, cutoff):
        position, scale, rotation, weight = (
            t.detach().contiguous() for t in (position, scale, rotation, weight)
        )
        table = box_table(box, position.device)
        record = ellipsoids(position, scale, rotation, weight, table, cutoff)
        ctx.save_for_backward(position, scale, rotation, weight, table, record)
        ctx.box, ctx.cutoff = box, cutoff
        return splat(record, len(weight), box, cutoff)

    @staticmethod
    def backward(ctx, grad_volume):
        position, scale, rotation, weight, table, record = ctx.saved_tensors
        if not (len(record) and grad_volume.numel()):
            return (*map(torch.zeros_like, (position, scale, rotation, weight)), None, None)
        moments = sum_moments(record, grad_volume, ctx.box, ctx.cutoff)
        return (*pull_back(position, scale, rotation, weight, table, moments), None, None)
