"""Matter beside the volume, where neither volume nor detector holds all of the object.

Rays of a region of interest pass through what lies around it. Gaussians that may lie in the volume alone would have to
stand for that, too; so the volume that is fitted is widened, and what was asked for is cut out of it in the end.
"""

from __future__ import annotations

import logging
import math

import numpy as np
import torch

from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.continued import few_rows, half_width
from tomo_polysplat.start.orbit import find_orbit
from tomo_polysplat.start.weights import ray_offsets

__all__ = ["cut_out", "widened_grid"]

logger = logging.getLogger(__name__)


def widened_grid(
    projections: np.ndarray, geometry: Geometry, grid: VolumeGrid, most: float, device: torch.device
) -> tuple[VolumeGrid, tuple[int, int], str]:
    """The volume to be fitted, by how many voxels it is wider on either side in y and x, and words that say why.

    Parameters
    ----------
    projections : (views, rows, columns) array
        -log(I/I0); NaN for rays that are not to be used.
    geometry, grid : Geometry, VolumeGrid
    most : float
        Share of its edges that the volume is widened by at most on every side; 0: never.
    device : torch.device
        Where that is asked: on the host of a GPU it took 3 ms or, until its threads had woken up, 80.
    """
    reach = None
    if most:
        few = torch.from_numpy(np.ascontiguousarray(few_rows(projections)))
        reach = half_width(few.to(device), geometry)
    orbit = find_orbit(geometry)[0] if reach is not None else None
    if reach is None or orbit is None:
        return grid, (0, 0), ""
    middle = 0.5 * (geometry.columns - 1)
    radius = float(np.abs(ray_offsets(geometry, orbit, (middle - reach, middle + reach))).mean())
    more = []
    for k in (1, 0):
        beyond = max(grid.lower[k] - orbit.axis[k], orbit.axis[k] - grid.upper[k]) + radius
        # Half a voxel less is none: an object that fills the volume touches its sides.
        wanted = math.ceil(beyond / grid.voxel_size[k] - 0.5)
        more.append(min(max(wanted, 0), math.ceil(most * grid.shape[2 - k])))
    if not any(more):
        return grid, (0, 0), ""
    margin = np.array([more[1], more[0], 0]) * grid.voxel_size
    nz, ny, nx = grid.shape
    wider = VolumeGrid((nz, ny + 2 * more[0], nx + 2 * more[1]), grid.lower - margin, grid.upper + margin)
    why = (
        f"fitted with {max(more)} voxels more on every side: the object reaches beyond the detector and the volume,"
        f" {radius:.3g} from the axis if it is round"
    )
    logger.info("The volume is %s", why)
    return wider, (more[0], more[1]), why


def cut_out(volume: np.ndarray, margin: tuple[int, int]) -> np.ndarray:
    """What was asked for of a volume (..., y, x) that is so much wider."""
    if not any(margin):
        return volume
    y, x = margin
    return np.ascontiguousarray(volume[..., y : volume.shape[-2] - y, x : volume.shape[-1] - x])
