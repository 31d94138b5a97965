"""The unknowns of the voxel baseline: an attenuation and a material number for each voxel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from tomo_polysplat.model.bone_numbers import start_numbers
from tomo_polysplat.scan.geometry import VolumeGrid
from tomo_polysplat.settings import Settings

__all__ = ["VoxelModel", "start_voxels"]


@dataclass
class VoxelModel:
    """The unknowns, in soft references at the reference energy.

    Attributes
    ----------
    relative : (nz, ny, nx) tensor
        Attenuation over ``size``.
    own : (free,) tensor
        Material number of the voxels that have one to fit.
    size : (nz, ny, nx) tensor
        Unit of the attenuation of each voxel, so that one step means as much in metal as in water.
    fixed : (nz * ny * nx,) tensor
        Material number of every voxel, used for those that are not free.
    free : (free,) int64 tensor
        Flat indices of the voxels whose material number is fitted: those near dense matter, where the start does not
        tell materials. If all were free, density and material number of soft matter would drift against each other.
    """

    relative: torch.Tensor
    own: torch.Tensor
    size: torch.Tensor
    fixed: torch.Tensor
    free: torch.Tensor

    def copy(self) -> VoxelModel:
        """A model with copies of the fitted tensors."""
        return replace(self, relative=self.relative.detach().clone(), own=self.own.detach().clone())

    def finite(self) -> bool:
        """Whether the fitted tensors are finite."""
        return all(bool(torch.isfinite(tensor).all()) for tensor in (self.relative, self.own))

    def weights(self, curve: torch.Tensor) -> torch.Tensor:
        """(3, nz, ny, nx) densities of the soft, middle and dense curve.

        ``curve`` (3,) is the mass attenuation of the curves at the reference energy over that of the first.
        """
        u = self.fixed.index_put((self.free,), self.own).view(self.relative.shape)
        mixture = torch.stack([(1 - u).square(), 2 * u * (1 - u), u.square()])
        at_reference = torch.einsum("k,kzyx->zyx", curve, mixture)
        return mixture * (self.relative * self.size / at_reference)

    @torch.no_grad()
    def hold(self) -> None:
        """Clamp the fitted tensors to physical values."""
        self.relative.clamp_(min=0.0)
        self.own.clamp_(0.0, 1.0)


def start_voxels(start: np.ndarray, grid: VolumeGrid, settings: Settings, device: torch.device) -> VoxelModel:
    """The model that a first reconstruction (nz, ny, nx), in soft references, suggests."""
    from scipy import ndimage

    u = start_numbers(torch.from_numpy(np.asarray(start, np.float32)), settings).numpy()
    u[start > settings.metal_level] = settings.metal_u
    dense = start > settings.bone_level
    reach = settings.free_radius * float(grid.voxel_size.min())
    near = np.zeros(start.shape, bool)
    if dense.any():
        near = ndimage.distance_transform_edt(~dense, sampling=grid.voxel_size[::-1]) <= reach
    size = np.maximum(ndimage.maximum_filter(start, [min(3, n) for n in start.shape]), 1.0)

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), device=device)

    free = np.flatnonzero(near)
    return VoxelModel(
        relative=tensor((np.maximum(start, 0) / size).astype(np.float32)),
        own=tensor(u.reshape(-1)[free]),
        size=tensor(size.astype(np.float32)),
        fixed=tensor(u.reshape(-1)),
        free=tensor(free),
    )
