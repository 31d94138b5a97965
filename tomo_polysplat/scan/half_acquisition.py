"""The volume of a scan with the axis off the middle and a whole turn, which sees twice as far on the longer side."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

import numpy as np

from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.scan.circular import volume_seen
from tomo_polysplat.scan.geometry import geometry_from_astra
from tomo_polysplat.scan.rotation_axis import axis_column, azimuth_of_views
from tomo_polysplat.scan.scan import Scan

__all__ = ["with_room"]

logger = logging.getLogger(__name__)

# Views and rows that are looked at, and columns next to the usual volume.
_VIEWS, _ROWS, _NEXT = 120, 16, 3
# No gap in a whole turn is so many radians wide.
_GAP = 0.5
# Beside the usual volume there is matter where the mean of these rays is above this share of what a typical ray
# measures, in this share of the views.
_MATTER, _SOME_VIEWS = 0.1, 0.05
# So many deviations of the noise are no matter either.
_SURE = 4.0
# Columns by which rounding may move the axis.
_ROUNDED = 1e-3


def with_room(scan: Scan) -> Scan:
    """The scan with a volume as wide as its views see, where matter lies beside the usual one; else the same object.

    A detector beside the axis sees one half of the object, and half a turn later the other. Its usual volume of as many
    voxels as columns would cut such an object off, all around.

    Parameters
    ----------
    scan : Scan
        Its volume is `volume_seen` of its geometry.
    """
    geometry = geometry_from_astra(scan.proj_geom)
    azimuth = np.sort(azimuth_of_views(geometry))
    if np.diff(azimuth, append=azimuth[0] + 2 * np.pi).max() > _GAP:
        return scan
    axis = axis_column(geometry) + 0.5
    usual = scan.vol_geom["GridColCount"]
    across = math.ceil(2 * max(axis, geometry.columns - axis) - _ROUNDED)
    if across <= usual or not _matter_beside(scan, axis, usual / 2):
        return scan
    height = scan.vol_geom["GridSliceCount"]
    words = "Detector beside the axis, and a whole turn: the volume is %d voxels wide for %d columns."
    logger.info(words, across, geometry.columns)
    return replace(scan, vol_geom=volume_seen(geometry, (height, across, across)))


def _matter_beside(scan: Scan, axis: float, reach: float) -> bool:
    """Whether rays that pass the axis at little more than `reach` columns see matter."""
    rows, views = (evenly_spread(count, most) for count, most in ((scan.rows, _ROWS), (scan.views, _VIEWS)))
    # Of what stays in a file no more is read.
    chosen = rows[:, None], views
    values = np.array(scan.projections[chosen], np.float64)
    values[~np.isfinite(values)] = np.nan
    if scan.valid is not None:
        values[~np.asarray(scan.valid[chosen])] = np.nan
    away = np.abs(np.arange(scan.columns) + 0.5 - axis)
    beside, within = values[..., (away > reach) & (away <= reach + _NEXT)], values[..., away <= reach]
    lit = within[np.isfinite(within)]
    if not lit.size or not beside.size:
        return False
    seen = np.isfinite(beside)
    mean = np.where(seen, beside, 0.0).sum(axis=(0, 2)) / np.maximum(seen.sum(axis=(0, 2)), 1)
    typical = float(np.median(lit[lit >= 0.1 * np.quantile(lit, 0.99)]))
    noise = 1.4826 * float(np.median(np.abs(np.diff(mean)))) / math.sqrt(2)
    return bool(typical > 0 and (mean > max(_MATTER * typical, _SURE * noise)).mean() > _SOME_VIEWS)
