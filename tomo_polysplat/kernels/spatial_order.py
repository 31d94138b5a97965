"""An order of Gaussians in which neighbours in space are neighbours in the list."""

from __future__ import annotations

import torch

__all__ = ["spatial_order"]

_BITS = 10  # cells an axis: 1024


def spatial_order(position: torch.Tensor) -> torch.Tensor:
    """Permutation (n,) int64 along a Morton (Z-order) curve through the bounding box of ``position`` (n, 3).

    The CUDA kernels look for Gaussians by groups of neighbours in the list, so a model kept in this order
    runs fast; sort it again whenever Gaussians are added or have moved far.
    """
    if not len(position):
        return torch.zeros(0, dtype=torch.int64, device=position.device)
    point = position.detach()
    lower, upper = point.amin(0), point.amax(0)
    cells = (point - lower) / (upper - lower).amax().clamp_min(torch.finfo(point.dtype).tiny)
    index = (cells * (2**_BITS - 1)).nan_to_num(0.0).long()
    # Spread the bits of every index two places apart: ...b2 b1 b0 -> ...b2 0 0 b1 0 0 b0.
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        index = (index | (index << shift)) & mask
    code = index[:, 0] | (index[:, 1] << 1) | (index[:, 2] << 2)
    return torch.argsort(code, stable=True)
