"""Small clouds of Gaussians whose volume is known."""

import numpy as np
import torch

from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.model.gaussians import Gaussians


def blocks(levels, size=11):
    """A block of Gaussians for each level, so wide that its lattice is flat; soft matter first."""
    scale, height = 0.6, 1 / (np.sqrt(2 * np.pi) * 0.6) ** 3
    corners = np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), -1).reshape(-1, 3).astype(float)
    places = [corners + [0, 0, 2 * size * k] for k in range(len(levels))]
    heights = [np.full(len(corners), level * height) for level in levels]
    groups = [np.full(len(corners), k) for k in range(len(levels))]
    count = len(levels) * len(corners)
    gaussians = Gaussians(
        torch.from_numpy(np.concatenate(places)).float(), torch.full((count, 3), np.log(scale)),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), torch.from_numpy(np.concatenate(heights)).float(),
        torch.zeros(count), torch.tensor([0.0] + [0.8] * (len(levels) - 1)),
        torch.from_numpy(np.concatenate(groups)), torch.zeros(1),
    )  # fmt: skip
    box = VoxelBox(np.zeros(3), np.ones(3), (2 * size * len(levels), size, size))
    return gaussians, box


def scene_of(box, numbers=None):
    """A scene of one energy with these voxels; ``numbers`` tells solids by their attenuation."""
    return FitScene(
        box, None, 1.0, None, None, -0.1, "reference", 0.1, False, (0.1, 0.1), False, 1, 0.2,
        solid_number=numbers,
    )  # fmt: skip
