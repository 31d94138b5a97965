"""Projection of voxel volumes in torch, differentiable: ASTRA's projectors on a GPU, ours on the CPU."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
import torch

from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.astra_pair import AstraPair, astra_has_gpu
from tomo_polysplat.start.joseph import JosephProjector

__all__ = ["ProjectorPair", "project_voxels", "projector_pair"]


class ProjectorPair(Protocol):
    """A linear map from voxels to rays and its adjoint, of any views."""

    def forward(self, volume: torch.Tensor, views: np.ndarray) -> torch.Tensor:
        """(views, rows, columns) line integrals of a volume (nz, ny, nx)."""

    def adjoint(self, projections: torch.Tensor, views: np.ndarray) -> torch.Tensor:
        """(nz, ny, nx) backprojection of projections (views, rows, columns)."""


@contextmanager
def projector_pair(geometry: Geometry, grid: VolumeGrid, device: torch.device) -> Iterator[ProjectorPair]:
    """The fastest pair there is for a device, released at the end of the block."""
    if device.type == "cuda" and astra_has_gpu():
        with AstraPair(geometry, grid, device) as pair:
            yield pair
    else:
        yield _JosephPair(geometry, grid)


class _JosephPair:
    def __init__(self, geometry: Geometry, grid: VolumeGrid) -> None:
        self.projector = JosephProjector(geometry, grid)

    def forward(self, volume: torch.Tensor, views: np.ndarray) -> torch.Tensor:
        projections = self.projector.forward(volume.cpu().numpy(), views)
        return torch.from_numpy(projections).to(volume.device)

    def adjoint(self, projections: torch.Tensor, views: np.ndarray) -> torch.Tensor:
        volume = self.projector.adjoint(projections.cpu().numpy(), views)
        return torch.from_numpy(volume).to(projections.device)


def project_voxels(volumes: torch.Tensor, pair: ProjectorPair, views: np.ndarray) -> torch.Tensor:
    """Line integrals of several volumes, differentiable once.

    Parameters
    ----------
    volumes : (channels, nz, ny, nx) float32 tensor
    pair : ProjectorPair
    views : (n,) integer array

    Returns
    -------
    (channels, n, rows, columns) float32 tensor
    """
    return _Project.apply(volumes, pair, views)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, volumes: torch.Tensor, pair: ProjectorPair, views: np.ndarray) -> torch.Tensor:
        ctx.pair, ctx.views = pair, views
        return torch.stack([pair.forward(volume, views) for volume in volumes.detach()])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        return torch.stack([ctx.pair.adjoint(part, ctx.views) for part in gradient.detach()]), None, None
