"""What each of several ranks holds of a fit: the Gaussians of a slab of z, and the planes of the volume they reach.

Images and volumes are sums over Gaussians. So each rank makes those of its own, they are added up, and each goes on
from the sum to the gradients of its own. Of volumes only the planes that several ranks reach have to be added up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from tomo_polysplat.kernels.step.faint import HALO
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.ranks import Ranks, part_of
from tomo_polysplat.render.renderer import VOXEL_CUTOFF

__all__ = ["Part", "Planes", "fit_in", "parted", "planes_of_all", "reached"]

# How far Gaussians and borders may get on from when planes were chosen for them: in planes, as a share of all planes,
# and as a factor of deviations. What reaches beyond is still seen by the rays, but not smoothed there; once a pass
# planes are chosen anew if need be.
_WANDERED, _OF_ALL, _WIDENED = 4, 1 / 32, 1.5


def parted(gaussians: Gaussians, count: int) -> list[torch.Tensor]:
    """Indices of the Gaussians of each of so many slabs of z, as many in each, in the order that they have."""
    order = gaussians.position.detach()[:, 2].argsort(stable=True)
    return [order[part_of(len(order), rank, count)].sort().values for rank in range(count)]


def reached(
    gaussians: Gaussians, parts: Sequence[torch.Tensor], box: VoxelBox, widened: float = 1.0
) -> list[slice]:
    """The planes of a volume that Gaussians ``widened`` so many times reach, of each part of them."""
    depth = box.shape[0]
    if gaussians.planar:
        return [slice(0, depth)] * len(parts)
    place = (gaussians.position.detach()[:, 2] - float(box.first[2])) / float(box.spacing[2])
    reach = gaussians.log_scale.detach().amax(dim=1).exp() * (widened * VOXEL_CUTOFF / float(box.spacing[2]))
    ends = [torch.stack([(place - reach)[part].amin(), (place + reach)[part].amax()]) for part in parts]
    # What is not finite ends the run.
    low, high = torch.stack(ends).double().nan_to_num(0.0).cpu().numpy().T
    first = np.clip(np.ceil(low), 0, depth).astype(int)
    last = np.clip(np.floor(high) + 1, first, depth).astype(int)
    return [slice(start, stop) for start, stop in zip(first.tolist(), last.tolist())]


@dataclass(frozen=True)
class Planes:
    """Planes of the volume that a rank makes, and which of all several ranks make.

    Attributes
    ----------
    own : slice
    shared : (m,) int array
    """

    own: slice
    shared: np.ndarray


def planes_of_all(gaussians: Gaussians, parts: Sequence[torch.Tensor], box: VoxelBox) -> list[Planes]:
    """Those of each rank, with room for what its Gaussians may come to reach until planes are chosen anew."""
    depth, made = box.shape[0], np.zeros(box.shape[0], int)
    # Some more: smoothing takes those beside the ones that are reached.
    wide = max(_WANDERED, round(_OF_ALL * depth)) + HALO
    own = []
    for part in reached(gaussians, parts, box, _WIDENED):
        own.append(slice(max(part.start - wide, 0), min(part.stop + wide, depth)))
        made[own[-1]] += 1
    return [Planes(each, np.flatnonzero(made > 1)) for each in own]


def fit_in(
    gaussians: Gaussians, parts: Sequence[torch.Tensor], box: VoxelBox, held: Sequence[Planes]
) -> bool:
    """Whether no Gaussian reaches beyond the planes of its part."""
    return all(
        max(now.start - HALO, 0) >= planes.own.start and min(now.stop + HALO, box.shape[0]) <= planes.own.stop
        for now, planes in zip(reached(gaussians, parts, box), held)
    )


class Part:
    """A rank's part of a fit.

    Parameters
    ----------
    ranks : Ranks
    planes : Planes
        Of the volume.
    device : torch.device
    """

    def __init__(self, ranks: Ranks, planes: Planes, device: torch.device) -> None:
        self.ranks, self.planes = ranks, planes.own
        mine = (planes.shared >= planes.own.start) & (planes.shared < planes.own.stop)
        self._here = torch.from_numpy(planes.shared[mine] - planes.own.start).to(device)
        self._there = torch.from_numpy(np.flatnonzero(mine)).to(device)
        self._shared = len(planes.shared)

    def box(self, box: VoxelBox) -> VoxelBox:
        """The voxels of its planes."""
        depth = self.planes.stop - self.planes.start
        return box.part((self.planes.start, 0, 0), (depth, *box.shape[1:]))

    def lent(self, volume: torch.Tensor) -> torch.Tensor:
        """(m, ny, nx) shared planes of a volume (nz, ny, nx) of the rank's planes, zero where these are not."""
        return volume.new_zeros((self._shared, *volume.shape[1:])).index_copy_(
            0, self._there, volume.index_select(0, self._here)
        )

    def take(self, planes: torch.Tensor, volume: torch.Tensor) -> None:
        """Put shared planes of all ranks in place."""
        volume.index_copy_(0, self._here, planes.index_select(0, self._there))

    def of_all(self, image: torch.Tensor) -> torch.Tensor:
        """The sum of images over the ranks, whose gradient is that of each."""
        return _Total.apply(image, self._add_up_image)

    def volume_of_all(self, volume: torch.Tensor) -> torch.Tensor:
        """A volume (nz, ny, nx) of the rank's planes, with what the others add to these; the gradient likewise."""
        return _Total.apply(volume, self._add_up_volume)

    def _add_up_image(self, image: torch.Tensor) -> None:
        self.ranks.sum_(image)

    def _add_up_volume(self, volume: torch.Tensor) -> None:
        planes = self.lent(volume)
        self.ranks.sum_(planes)
        self.take(planes, volume)


class _Total(torch.autograd.Function):
    """The sum over ranks of what each has a part of; the gradient by a part is the gradient by the sum."""

    @staticmethod
    def forward(ctx, own, add_up):
        total = own.clone(memory_format=torch.contiguous_format)
        add_up(total)
        return total

    @staticmethod
    def backward(ctx, gradient):
        return gradient, None
