"""Whether all matter of a scan lies within its volume."""

from __future__ import annotations

import logging

import numpy as np
import torch

from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.continued import cut_rows

__all__ = ["NOTHING", "matter_is_inside", "typical_ray"]

logger = logging.getLogger(__name__)

# Views, and rows and columns of each, that are looked at.
_VIEWS, _LINES = 24, 64
_RAYS_AT_ONCE = 1 << 17
# Fewer rays beside the volume than this share of all say nothing.
_FEWEST = 0.01
# A ray that stays below this part of a typical one sees nothing.
NOTHING = 0.1
# Rays beside the volume see nothing when all but this share of them do.
_SHARE = 0.01
# Of the views and rows, the share in which matter is seen next to the volume if that is too small.
_MOST = 0.5


def matter_is_inside(projections: torch.Tensor, geometry: Geometry, grid: VolumeGrid) -> tuple[bool, str]:
    """Whether rays pass beside the volume and see nothing there, and words that say so.

    Parameters
    ----------
    projections : (views, rows, columns) tensor
        -log(I/I0); NaN where a ray is not to be used.
    geometry, grid : Geometry, VolumeGrid
    """
    some = evenly_spread(geometry.views, _VIEWS)
    rows, columns = (np.arange(0, count, -(-count // _LINES)) for count in (geometry.rows, geometry.columns))
    device = projections.device
    chosen = (torch.from_numpy(index).to(device) for index in np.ix_(some, rows, columns))
    values = projections[tuple(chosen)].cpu().numpy()
    beside = ~_crosses(geometry.select(some), grid, rows, columns, device) & np.isfinite(values)
    through = values[~beside & np.isfinite(values)]
    typical = typical_ray(through)
    if beside.sum() < max(_FEWEST * values.size, 1) or not len(through):
        if cut_rows(projections[some.tolist()][:, rows.tolist()]) is not None:
            logger.warning(
                "The object reaches beyond the detector on both sides, and few rays pass beside the volume: what lies"
                " there ends up in the volume, which is too dense towards its border. Make the volume large enough for"
                " all of the object, if it is not."
            )
            return False, "not kept within the volume: the object reaches beyond the detector on both sides"
        if not len(through) and _missed(geometry.select(some), grid, device):
            logger.warning(
                "No ray meets the volume: check its window, the unit of length and the geometry, which may differ by a"
                " large factor."
            )
            return False, "not kept within the volume: no ray meets it"
        return False, "not kept within the volume: too few rays pass beside it to say what lies there"
    if float(np.quantile(values[beside], 1 - _SHARE)) > NOTHING * typical:
        if _cut(values, beside, typical):
            logger.warning(
                "The object reaches beyond the volume: rays next to it see matter, which ends up in the volume, too"
                " dense towards its border. Make the volume larger, or check its window and the geometry."
            )
            return (
                False,
                "not kept within the volume: rays beside it see matter, as the object reaches beyond it",
            )
        return False, "not kept within the volume: rays beside it see matter"
    return True, "kept within the volume: rays beside it see nothing"


def typical_ray(values: np.ndarray) -> float:
    """The median of rays that see something."""
    top = values.max(initial=0.0)
    return float(np.median(values[values >= 0.1 * top])) if top > 0 else 0.0


def _missed(geometry: Geometry, grid: VolumeGrid, device: torch.device) -> bool:
    """Whether no ray meets the volume, which those that were looked at may have missed alone."""
    return not _crosses(geometry, grid, np.arange(geometry.rows), np.arange(geometry.columns), device).any()


def _cut(values: np.ndarray, beside: np.ndarray, typical: float) -> bool:
    """Whether rays next to the volume see matter in most views and rows that see both it and what is beside it.

    A turntable or a holder is seen by few of them. Rows above and below the volume have no say: part of a longer object
    may be all that is wanted.
    """
    crossing = np.isfinite(values) & ~beside
    near = np.zeros_like(beside)
    near[..., 1:] |= crossing[..., :-1]
    near[..., :-1] |= crossing[..., 1:]
    near &= beside
    told = near.any(axis=-1)
    seen = (near & (np.nan_to_num(values) > NOTHING * typical)).any(axis=-1)
    return bool(told.any() and seen[told].mean() > _MOST)


def _crosses(
    geometry: Geometry, grid: VolumeGrid, rows: np.ndarray, columns: np.ndarray, device: torch.device
) -> np.ndarray:
    """(views, rows, columns) bool: rays that meet the window (its slabs: Kay and Kajiya 1986, SIGGRAPH).

    Found where the projections are: a GPU takes no time, and a host's threads may take tens of milliseconds to wake up.
    """
    arrays = (geometry.corner, geometry.u, geometry.v, geometry.origin, grid.lower, grid.upper, rows, columns)
    corner, u, v, origin, lower, upper, row, column = (
        torch.tensor(array, dtype=torch.float64, device=device) for array in arrays
    )
    crossed = np.empty((geometry.views, len(rows), len(columns)), bool)
    many = max(1, _RAYS_AT_ONCE // max(1, len(rows) * len(columns)))
    for first in range(0, geometry.views, many):
        some = slice(first, first + many)
        corners, us, vs, origins = (array[some, None, None] for array in (corner, u, v, origin))
        pixel = corners + row[:, None, None] * vs + column[:, None] * us
        ray = origins if geometry.beam == "parallel" else pixel - origins
        # A direction of 0 along an axis never reaches that slab's faces; a tiny one does, far away.
        ray = torch.where(ray.abs() < 1e-30, 1e-30, ray)
        ends = (lower - pixel) / ray, (upper - pixel) / ray
        enters, leaves = torch.minimum(*ends).amax(dim=-1), torch.maximum(*ends).amin(dim=-1)
        crossed[some] = (enters < leaves).cpu().numpy()
    return crossed
