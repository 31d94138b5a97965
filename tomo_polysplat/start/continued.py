"""Rows of a detector that does not see all of the object, continued beyond both of its ends.

Filtered backprojection takes what lies beyond the ends for nothing. The ramp makes a step at an end of that, which
comes out as a bright rim of what is seen and as emptiness beyond.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch

from tomo_polysplat.physics.typical import typical_value
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.fdk import fits_fdk
from tomo_polysplat.start.orbit import Orbit, find_orbit
from tomo_polysplat.start.weights import ray_offsets
from tomo_polysplat.start.whole_rows import Continuation, ends_of

__all__ = ["continuation", "continued", "cut_rows", "few_rows", "half_width"]

_Array = TypeVar("_Array", np.ndarray, torch.Tensor)

# A row sees the object where its largest ray has this part of a typical one, and an end sees matter where it has that.
# The object is cut where both ends do in this share of the rows that see it.
_OBJECT, _NOTHING, _MOST = 0.5, 0.1, 0.5
# Rays through metal would tell of a smaller object than there is: what is more than this many typical rays counts as so
# much. In six scans of 40^3 of which a third to a half was not seen the half-width is told within 1.2 columns so.
_DENSE = 1.5
# The shorter side of a detector is at least this share of the longer one where its middle counts as the object's.
_CENTRED = 0.8
# Views, and rows of each, that tell.
_VIEWS, _ROWS = 48, 64
# Columns that a row is continued by, as shares of those it has: even a square object ends, and a round one is never so
# large that more would matter.
_LEAST, _FARTHEST = 0.05, 0.75


def cut_rows(projections: torch.Tensor) -> torch.Tensor | None:
    """(n, columns) rows of an object that is cut at both ends of its rows; else None.

    It is cut where most rows that see the object see it at both of their ends. What would tell of metal is taken off.

    Parameters
    ----------
    projections : (views, rows, columns) tensor
        -log(I/I0); what is not finite sees nothing.
    """
    values = projections.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
    typical = typical_value(values)
    if typical is None:
        return None
    rows = values[values.amax(dim=-1) > _OBJECT * typical].clamp(max=_DENSE * typical)
    both = ends_of(rows).amin(dim=-1) > _NOTHING * typical
    return rows if len(rows) and both.float().mean() > _MOST else None


def half_width(projections: torch.Tensor, geometry: Geometry) -> float | None:
    """Columns from the detector's middle to where an object ends that is cut at both ends of its rows; else None.

    The detector has to be in the middle, before the axis of an orbit: one that is beside it tells of one side alone.
    Where a homogeneous ellipse ends the square of line integrals has fallen to zero; it falls with the square of the
    distance from the middle, by as much as the mean row of the object does over the columns there are.

    Parameters
    ----------
    projections : (views, rows, columns) tensor
        -log(I/I0); what is not finite sees nothing.
    geometry : Geometry
    """
    rows = cut_rows(few_rows(projections))
    if rows is None:
        return None
    orbit, _ = find_orbit(geometry)
    if orbit is None or not _centred(geometry, orbit):
        return None
    columns = projections.shape[2]
    half = 0.5 * (columns - 1)
    square = rows.mean(dim=0).double() ** 2
    x = torch.arange(columns, device=square.device, dtype=square.dtype) - half
    place = x**2 - (x**2).mean()
    slope = -float((square * place).sum() / (place**2).sum())
    height = float(square.mean()) + slope * float((x**2).mean())
    # A mean row that does not fall towards its ends tells of no end.
    reach = math.sqrt(height / slope) if slope > 0 else math.inf
    return min(max(reach, half + _LEAST * columns), half + _FARTHEST * columns)


def continuation(projections: torch.Tensor, geometry: Geometry, grid: VolumeGrid) -> Continuation:
    """How the rows of a scan go on.

    A row that ends in matter goes on as one of a homogeneous ellipse of that `half_width` would. Continuing rows as
    those of a uniform object is the idea of Hsieh et al. (Med. Phys. 31, 2385, 2004, doi:10.1118/1.1776673). Where the
    object is not cut at both ends, or part of a turn is too short for a wider fan, all is left as it is.

    Parameters
    ----------
    projections : (views, rows, columns) tensor
        -log(I/I0), finite; its `few_rows` are enough.
    geometry, grid : Geometry, VolumeGrid
        Of the whole scan, for which filtered backprojection fits.
    """
    reach = half_width(projections, geometry)
    if reach is None:
        return Continuation(geometry)
    more = math.ceil(reach - 0.5 * (geometry.columns - 1))
    wider = replace(geometry, columns=geometry.columns + 2 * more, corner=geometry.corner - more * geometry.u)
    if not fits_fdk(wider, grid)[0]:
        return Continuation(geometry)
    words = f"; rows continued by {more} columns at both ends, where the object reaches beyond"
    return Continuation(wider, more, reach, words)


def continued(
    projections: torch.Tensor, geometry: Geometry, grid: VolumeGrid
) -> tuple[torch.Tensor, Geometry, str]:
    """All projections as their `continuation` has them, their geometry, and words that say so."""
    found = continuation(projections, geometry, grid)
    return found.of(projections), found.geometry, found.words


def _centred(geometry: Geometry, orbit: Orbit) -> bool:
    """Whether the axis is before the middle of the detector."""
    first, last = np.abs(ray_offsets(geometry, orbit, (0, geometry.columns - 1))).mean(axis=0)
    return min(first, last) > _CENTRED * max(first, last)


def few_rows(projections: _Array) -> _Array:
    """Enough views and rows of (views, rows, columns) to tell by, evenly spread."""
    views, rows, _ = projections.shape
    return projections[:: max(1, views // _VIEWS), :: max(1, rows // _ROWS)]
