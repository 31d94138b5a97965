"""Find metal in a volume and in its projections, for methods that replace its rays."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import torch

from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.settings import Settings
from tomo_polysplat.start.initial import initial_volume
from tomo_polysplat.start.levels import mass_level
from tomo_polysplat.start.voxel_projector import projector_pair

__all__ = ["MetalTrace", "find_metal", "forward_project", "replace_trace"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class MetalTrace:
    """Metal, found by a threshold.

    Attributes
    ----------
    start : (nz, ny, nx) float32
        The smooth first reconstruction to which the threshold was applied, in 1/unit.
    soft : float
        Attenuation of the object's main matter in it.
    mask : (nz, ny, nx) bool
        Its voxels of metal.
    rays : (views, rows, columns) bool
        Rays through these voxels.
    """

    start: np.ndarray
    soft: float
    mask: np.ndarray
    rays: np.ndarray


def find_metal(
    projections: np.ndarray,
    geometry: Geometry,
    grid: VolumeGrid,
    *,
    level: float | None = None,
    device: str = "cpu",
) -> MetalTrace:
    """Apply a threshold to a first reconstruction and project the voxels above it.

    Parameters
    ----------
    projections : (views, rows, columns) float32
        NaN where not measured.
    geometry, grid : Geometry, VolumeGrid
    level : float, optional
        Threshold in multiples of the main matter; None for the level at which our own fit starts metal.
    device : {"cpu", "cuda", "cuda:N"}
    """
    start, _ = initial_volume(projections, geometry, grid, device=device)
    soft = mass_level(start)
    times = Settings().metal_level if level is None else level
    mask = start > times * soft
    if not mask.any():
        logger.warning(
            "No metal: the densest voxel has %.2g times the main matter, the threshold is %g. No ray is replaced.",
            float(start.max()) / soft if soft else 0.0,
            times,
        )
    path = forward_project(mask.astype(np.float32), geometry, grid, device=device)
    # Half a voxel of metal. Less is the blur of its edge; a wider trace would replace too many good rays.
    return MetalTrace(start, soft, mask, path > 0.5 * float(grid.voxel_size.min()))


def forward_project(
    volume: np.ndarray, geometry: Geometry, grid: VolumeGrid, *, device: str = "cpu"
) -> np.ndarray:
    """(views, rows, columns) line integrals of a volume (nz, ny, nx)."""
    target = torch.device(device)
    tensor = torch.from_numpy(np.ascontiguousarray(volume, dtype=np.float32)).to(target)
    with projector_pair(geometry, grid, target) as pair:
        return np.ascontiguousarray(pair.forward(tensor, np.arange(geometry.views)).cpu().numpy())


def replace_trace(volume: np.ndarray, metal: MetalTrace) -> np.ndarray:
    """The volume with the metal of the first reconstruction put back."""
    return np.where(metal.mask, metal.start, volume)
