"""The level of air, taken out of the rays before anything else is asked of them.

A beam that is dimmer than its flats by the same factor in all views, as flats of another exposure have it, looks like
matter all around. Where rays beside the object tell it (`scan.probes.air`), it is no matter.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence

import numpy as np

from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.nuisances.scatter import ScatteredLight
from tomo_polysplat.physics.scatter import LARGEST_SCATTER
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.scan.defects import fill_invalid
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.scan.probes.air import Air, look_for_air
from tomo_polysplat.scan.probes.beam import SATURATED_SHARE, TOO_DIM, beside_the_object, is_off
from tomo_polysplat.scan.rotation_axis import axis_column, reach_of

__all__ = ["take_out_level"]

logger = logging.getLogger(__name__)

# Rays that are looked at, of rows evenly spread, so many at least.
_RAYS, _ROWS = 1 << 22, 4
# Rays that are looked at for how much the values differ.
_SOME = 1 << 20
# A ray is darker than scatter by so many deviations of its noise; behind matter there may be this share of what is
# beside it.
_DEVIATIONS, _BEHIND = 3.0, 0.5


# What a caller tells of the rays and wants of them.
def take_out_level(
    values: np.ndarray,
    given: Sequence[float],
    geometry: Geometry,
    grid: VolumeGrid,
    *,
    wanted: bool | None,
    scatter_is_asked: bool,
) -> Answer:
    """Take out of the rays what those beside the object hold, where that is beyond doubt; for the plan, what it was.

    Parameters
    ----------
    values : (views, rows, columns) float32 array
        -log(I/I0), changed in place; NaN where a ray is not to be used.
    given : sequence of float
        Values that opaque and saturated rays were given, which stay.
    geometry, grid : Geometry, VolumeGrid
        In one unit.
    wanted : bool or None
        Of `Settings.beam`: False leaves it in, True takes out what such rays hold in doubt, too.
    scatter_is_asked : bool
        Whether the run asks the rays about scatter, which makes rays beside the object brighter as well.

    Returns
    -------
    Answer
        The brightness of the beam in open fields, 1 where nothing was taken out.
    """
    if wanted is False:
        return Answer(1.0, "asked for", Status.GIVEN)
    air = _air(values, geometry, grid)
    why_not = _why_not(air, values, given, wanted, scatter_is_asked)
    if air is None or why_not:
        return Answer(1.0, why_not, Status.ASKED, {} if air is None else _evidence(air))
    for view in values:
        measured = ~np.isin(view, np.array(given, np.float32)) if len(given) else True
        np.subtract(view, np.float32(air.level), out=view, where=measured)
    why = f"{beside_the_object(air)} (standard error {air.error:.2g}), taken out of all rays"
    tell = logger.warning if is_off(air) else logger.info
    tell("%s; settings={'beam': False} leaves it in.", why[0].upper() + why[1:])
    return Answer(math.exp(-air.level), why, Status.ASKED, _evidence(air))


def _evidence(air: Air) -> dict[str, float]:
    return {"level": air.level, "error": air.error}


def _air(values: np.ndarray, geometry: Geometry, grid: VolumeGrid) -> Air | None:
    """The rays beside the object; None where there are none."""
    views, rows, columns = values.shape
    chosen = evenly_spread(rows, max(_ROWS, _RAYS // (views * columns)))
    some = values[:, chosen].swapaxes(0, 1)
    good = np.isfinite(some)
    # Views that were not measured, and then rows, have nothing to go by.
    seen = good.any(axis=(0, 2))
    some, good = some[:, seen], good[:, seen]
    whole = good.any(axis=2).all(axis=1)
    if not whole.any():
        return None
    filled = fill_invalid(some[whole], good[whole])
    low, high = np.percentile(filled.ravel()[:: -(-filled.size // _SOME)], [1, 99])
    return look_for_air(filled, float(high - low), axis_column(geometry), reach_of(geometry, grid))


def _why_not(
    air: Air | None, values: np.ndarray, given: Sequence[float], wanted: bool | None, scatter_is_asked: bool
) -> str:
    """Why the level stays in the rays; empty where it is taken out."""
    if air is None:
        return "no rays beside the object tell"
    if air.share >= SATURATED_SHARE or 0.0 in given:
        return "rays beside the object were saturated, or without noise"
    if wanted:
        return ""
    if not air.sure:
        if is_off(air) and air.level > 0:
            told = f"{beside_the_object(air)}, or matter lies there"
            logger.warning("Matter will seem to lie all around the object: %s; %s.", told, TOO_DIM)
            return f"{told}: rays beside the object do not tell which"
        return "rays beside the object show no other"
    brighter = math.expm1(-air.level)
    if scatter_is_asked and 0 < brighter <= LARGEST_SCATTER and _may_be_scatter(brighter, air, values):
        return f"{beside_the_object(air)}, which may be scatter: asked in the run"
    return ""


def _may_be_scatter(scatter: float, air: Air, values: np.ndarray) -> bool:
    """Whether no more rays are darker than so much scatter than by a fault of theirs."""
    least = _BEHIND * scatter - _DEVIATIONS * air.noise * math.sqrt(_BEHIND * scatter)
    if least <= 0:
        return True
    darker = sum(int(np.count_nonzero(view > -math.log(least))) for view in values)
    return ScatteredLight.possible({"darker": darker, "rays": values.size})
