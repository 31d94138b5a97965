"""Gaussians to detector images and to voxels."""

from __future__ import annotations

import numpy as np
import torch

from tomo_polysplat.kernels.project.autograd import project
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.kernels.voxelise.autograd import voxelise
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid

__all__ = ["VOXEL_CUTOFF", "detector_views", "project_gaussians", "voxel_box", "voxelise_gaussians"]

# Where a volume's Gaussians end so that they hold the same mass as a projected one cut at 3 deviations,
# 1 - exp(-9/2) of the whole: the solution c of erf(c/sqrt 2) - sqrt(2/pi) c exp(-c^2/2) = 1 - exp(-9/2).
VOXEL_CUTOFF = 3.3682


def detector_views(geometry: Geometry, planar: bool) -> DetectorViews:
    """The arrays the kernels need of a geometry."""
    cone = geometry.beam == "cone"
    direction = geometry.corner - geometry.origin if cone else geometry.origin
    matrix = np.stack([geometry.u, geometry.v, direction], axis=2)
    origin = geometry.origin if cone else geometry.corner
    return DetectorViews(cone, origin, matrix, geometry.rows, geometry.columns, planar)


def voxel_box(grid: VolumeGrid) -> VoxelBox:
    """All voxels of a grid."""
    return VoxelBox(grid.lower + 0.5 * grid.voxel_size, grid.voxel_size, grid.shape)


def project_gaussians(
    gaussians: Gaussians, weights: torch.Tensor, views: DetectorViews, kernel: str, cutoff: float
) -> tuple[torch.Tensor, int]:
    """(channels, views, rows, columns) line integrals, and the pairs skipped at the source plane."""
    return project(
        gaussians.position,
        gaussians.scale(),
        gaussians.rotation,
        weights,
        views,
        kernel=kernel,
        cutoff=cutoff,
    )


def voxelise_gaussians(
    gaussians: Gaussians, weights: torch.Tensor, box: VoxelBox, kernel: str
) -> torch.Tensor:
    """(channels, nz, ny, nx) sums of the Gaussians at voxel centres."""
    return voxelise(
        gaussians.position,
        gaussians.scale(),
        gaussians.rotation,
        weights,
        box,
        kernel=kernel,
        cutoff=VOXEL_CUTOFF,
    )
