"""Make seeds thin across the edges of the start, and wider along them.

If there are fewer Gaussians than the detector could tell apart, round ones cannot show the edges, and a fit has few
steps to turn and flatten them. Even a noisy start tells the direction of its edges.
"""

from __future__ import annotations

import numpy as np
import torch

from tomo_polysplat.model.seed_samples import box_mean, reaches, voxel_of
from tomo_polysplat.scan.geometry import VolumeGrid
from tomo_polysplat.settings import Settings

__all__ = ["edge_shapes"]

# Against noise the start is averaged twice over this many voxels along each axis, before its slope is taken.
_AVERAGED = 3
# No seed is thinner than this share of a round one: neighbours would no longer overlap (teeth, 96^3 voxels: 54.2 dB
# everywhere with 0.4, 53.5 with 0.3).
_THINNEST = 0.4


# Seeds and their start, and how thin they may get: nothing else holds these together.
def edge_shapes(
    start: torch.Tensor,
    points: torch.Tensor,
    size: torch.Tensor,
    grid: VolumeGrid,
    settings: Settings,
    finest: float,
    dims: int,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Rotations and changes of scale of seeds, by the slope of the start.

    Parameters
    ----------
    start : (nz, ny, nx) tensor
        In soft references; values above ``metal_level`` count as ``metal_level``.
    points : (n, 3) tensor
        The seeds, in the grid's unit.
    size : (n,) tensor
        Distance of a seed from its neighbours, in the grid's unit.
    grid : VolumeGrid
    settings : Settings
        ``seed_edge`` is the variation of the start over a seed's size that makes the seed half as thick. With 0 all are
        round.
    finest : float
        Distance, in the grid's unit, of the closest seeds that the detector could tell apart. No seed gets thinner than
        these would be, because the scan may be no sharper: without this bound fan-beam slices with blurred edges lose
        1.7 dB. 0 where edges are known to be sharp.
    dims : int
        2 or 3.

    Returns
    -------
    rotation : (n, 4) tensor
        Quaternions (w, x, y, z) that turn the first axis to the slope.
    log_scale : (n, dims) tensor
        To be added to the logarithms of the deviations. They sum to 0, so the mass does not change.
    """
    rotation, change = points.new_zeros((len(points), 4)), points.new_zeros((len(points), dims))
    rotation[:, 0] = 1.0
    half = settings.seed_edge
    if not (half and bool((size > finest).any())):
        return rotation, change
    # Seeds at metal are fine enough, and beside metal the start is too uncertain to follow its edges.
    beside = reaches(start, points, grid, settings.metal_level, float(grid.voxel_size[:dims].min()))
    size = size.masked_fill(beside, 0.0)
    slope = _slope(start, settings.metal_level, points, grid, dims)
    steepness = slope.norm(dim=1)
    direction = slope / steepness.clamp(min=torch.finfo(slope.dtype).tiny)[:, None]
    # The sign of an axis is free. This one avoids rotations by half a turn, whose own axis is not defined.
    direction = torch.where(direction[:, :1] < 0, -direction, direction)
    rotation[:, 0] = 1 + direction[:, 0]
    rotation[:, 2], rotation[:, 3] = -direction[:, 2], direction[:, 1]
    thinnest = (finest / size.clamp(min=torch.finfo(size.dtype).tiny)).clamp(_THINNEST, 1.0)
    thinner = torch.maximum(half / (half + steepness * size), thinnest).log()
    change[:, 0] = thinner
    change[:, 1:] = -thinner[:, None] / (dims - 1)
    return torch.nn.functional.normalize(rotation, dim=1), change


def _slope(
    start: torch.Tensor, metal_level: float, points: torch.Tensor, grid: VolumeGrid, dims: int
) -> torch.Tensor:
    """(n, 3) derivatives along x, y and z of the start, smoothed, at the seeds."""
    window = np.minimum(_AVERAGED, start.shape)
    smooth = box_mean(start.clamp(0.0, metal_level), window)
    smooth = box_mean(smooth, window)
    index = voxel_of(points, grid)
    slope = points.new_zeros((len(points), 3))
    for k in range(dims):
        axis = 2 - k
        before, behind = list(index), list(index)
        before[axis] = (index[axis] - 1).clamp(min=0)
        behind[axis] = (index[axis] + 1).clamp(max=start.shape[axis] - 1)
        length = (behind[axis] - before[axis]).clamp(min=1) * float(grid.voxel_size[k])
        slope[:, k] = (smooth[tuple(behind)] - smooth[tuple(before)]) / length
    return slope
