"""What the fit minimises: the misfit of the rays and the roughness of the volume."""

from __future__ import annotations

import torch

__all__ = ["total_variation", "weighted_l1"]


def weighted_l1(predicted: torch.Tensor, measured: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    r"""Weighted mean of the absolute residuals, ``sum w |p - m| / sum w``; 0 when every weight is 0."""
    return ((predicted - measured).abs() * weight).sum() / weight.sum().clamp(min=1e-12)


def total_variation(volume: torch.Tensor, ceiling: float) -> torch.Tensor:
    """Mean absolute difference of neighbouring voxels per axis, summed over the axes.

    Parameters
    ----------
    volume : (nz, ny, nx) tensor
        Axes of length one contribute nothing.
    ceiling : float
        Values above it count as it: a piece of metal should not pay for its brightness, only for its surface.
    """
    clipped = volume.clamp(max=ceiling)
    total = volume.new_zeros(())
    for axis in range(volume.ndim):
        if volume.shape[axis] > 1:
            total = total + clipped.diff(dim=axis).abs().mean()
    return total
