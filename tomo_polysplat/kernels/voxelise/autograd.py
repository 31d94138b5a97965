"""Voxelising as a differentiable torch operation, whichever implementation does the work."""

from __future__ import annotations

import torch

from tomo_polysplat.kernels.voxelise import reference
from tomo_polysplat.kernels.voxelise.box import VoxelBox

__all__ = ["voxelise"]


def voxelise(
    position: torch.Tensor,
    scale: torch.Tensor,
    rotation: torch.Tensor,
    weight: torch.Tensor,
    box: VoxelBox,
    *,
    kernel: str,
    cutoff: float,
) -> torch.Tensor:
    """Sum of weighted Gaussians at voxel centres; arguments and result as in ``reference.voxelise``.

    ``kernel`` is ``"reference"``, ``"numba"`` or ``"triton"``; the compiled ones take float32 only.
    """
    if kernel == "reference":
        return reference.voxelise(position, scale, rotation, weight, box, cutoff)
    if kernel == "numba":
        return _NumbaVoxelise.apply(position, scale, rotation, weight, box, cutoff)
    from tomo_polysplat.kernels.voxelise import triton_kernel

    return triton_kernel.voxelise(position, scale, rotation, weight, box, cutoff)


class _NumbaVoxelise(torch.autograd.Function):
    @staticmethod
    def forward(ctx, position, scale, rotation, weight, box, cutoff):
        from tomo_polysplat.kernels.voxelise import numba_kernel

        arrays = [t.detach().contiguous().numpy() for t in (position, scale, rotation, weight)]
        position, scale, rotation, weight = arrays
        ctx.arrays, ctx.box, ctx.cutoff = arrays, box, cutoff
        return torch.from_numpy(numba_kernel.forward(position, scale, rotation, weight, box, cutoff))

    @staticmethod
    def backward(ctx, grad_volume):
        from tomo_polysplat.kernels.voxelise import numba_kernel

        position, scale, rotation, weight = ctx.arrays
        grads = numba_kernel.backward(
            position, scale, rotation, weight, ctx.box, ctx.cutoff, grad_volume.numpy()
        )
        return (*map(torch.from_numpy, grads), None, None)
