"""By how many columns the axis of rotation is off, and how sure that is, from rays measured from both ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.scan.opposite_geometry import opposite_rays_of
from tomo_polysplat.scan.opposite_rays import OppositeRays
from tomo_polysplat.scan.view_geometry import Geometry

__all__ = ["LARGEST_SHARE", "AxisOffset", "axis_offset", "offset_of", "spread"]

# Half the range that is searched, as a share of the columns, and columns of the detector that it is searched on.
LARGEST_SHARE, _COARSE = 0.12, 96
# Views and columns that are compared, and of the coarse search.
_VIEWS, _COLUMNS = 128, 512
_COARSE_VIEWS, _COARSE_ROWS = 60, 8
# Share of the most pairs of any place that a place must have.
_ENOUGH = 0.2
# A place farther than so many joined columns is another one; its rays must differ so many times more.
_ELSEWHERE, _CLEARLY = 2.0, 2.0
# Where more than this of the variance is not shared, rays are not opposite.
_LARGEST_MISMATCH = 0.25
# Steps of Newton's method, in columns at most, and how small the last must be.
_STEPS, _LONGEST, _SETTLED = 12, 0.5, 1e-3
# The slope is taken between places so far on either side, in columns.
_APART = 0.25
# Groups of lines and of columns, each left out once; fewer lines than these are cut by rows instead.
_LINE_GROUPS, _COLUMN_GROUPS, _FEWEST_LINES, _FEWEST_GROUPS = 16, 12, 8, 4
# Standard errors by which slopes along columns and of opposite rays must be correlated, and pairs that noise makes
# alike: neighbours, by smoothing, and each pair is there twice.
_CORRELATED, _ALIKE = 4.0, 6.0
# Places between other views at which the rule of the seam is tried.
_SEAMS = 24


@dataclass(frozen=True)
class AxisOffset:
    """Where the axis of rotation is.

    Attributes
    ----------
    columns : float
        By which the detector stood above where it was told, as ``u`` of `tomo_polysplat.scan.moves` counts.
    error : float
        Its standard error.
    doubt : str
        Why nothing is known; empty where it is.
    """

    columns: float
    error: float
    doubt: str = ""


def axis_offset(projections: np.ndarray, geometry: Geometry, valid: np.ndarray | None = None) -> AxisOffset:
    """Tell by how many columns the detector was off, from opposite rays.

    Parameters
    ----------
    projections : (views, rows, columns) array
        -log(I/I0); NaN for rays that are not to be used.
    geometry : Geometry
        As told.
    valid : (views, rows, columns) bool array, optional
        Rays to use, of those that are finite.

    Returns
    -------
    AxisOffset
        Unknown where no ray was measured from both ends, where such rays do not agree wherever the axis is, or where
        they agree at several places.

    Notes
    -----
    What all views share is left out: it is a body of revolution about the axis, or defects of pixels that seem to be
    one. Only at the seam of half a turn, of two lines, it cannot be; what is linear along columns is left out there.

    Of a parallel beam some of all rows are compared, of a fan or cone the row in the plane of the orbit, where a ray
    runs both ways. The place is found on joined columns and refined by Newton's method on all of them. Its standard
    error is the jackknife's (Efron 1982): the larger one of that over groups of views, whose noise differs, and of that
    over groups of columns, whose gains do. What is added to its square is of views too far apart: by how much the place
    changes if rays between two views bend as their neighbours do, or, of half a turn, the place that comes out between
    neighbouring views, where it is known: single views that have moved show in that.
    """
    try:
        return offset_of(opposite_rays_of(projections, geometry, valid))
    except ValueError as why:
        return AxisOffset(0.0, np.inf, str(why))


def offset_of(rays: OppositeRays) -> AxisOffset:
    """What `axis_offset` tells, of rays that are put together."""
    try:
        found, step = _rough(rays)
        limit = LARGEST_SHARE * rays.values.shape[1]
        while True:
            found, error = _refined(rays.joined(step), found / step, limit / step)
            found *= step
            if step == 1:
                break
            step = (step + 1) // 2
        if not rays.seam:
            found, error = _refined(rays, found, limit, varying=True)
        if rays.one_pair:
            # The mean of what moved either of the two; what the rule of the seam tells is moved by about twice as many.
            error = float(np.hypot(error, _elsewhere(rays, spread(rays, _VIEWS)[1]) / np.sqrt(2)))
    except ValueError as why:
        return AxisOffset(0.0, np.inf, str(why))
    if not np.isfinite(error):
        return AxisOffset(0.0, np.inf, "too few rays show detail from both ends")
    return AxisOffset(-found, error)


def _rough(rays: OppositeRays) -> tuple[float, int]:
    """The place where opposite rays agree best, in columns, and how many columns were joined to find it."""
    columns = rays.values.shape[1]
    factor = max(1, columns // _COARSE)
    some = evenly_spread(rays.values.shape[2], _COARSE_ROWS)
    coarse = OppositeRays(rays.values[..., some], rays.azimuth, rays.axis, rays.slope).joined(factor)
    lines, columns = spread(coarse, _COARSE_VIEWS)
    reach = np.ceil(LARGEST_SHARE * len(columns))
    places = np.arange(-reach, reach + 0.25, 0.5)
    compared = [coarse.pairs(place, lines, columns) for place in places]
    many = np.array([np.count_nonzero(pairs.weight) for pairs in compared])
    if not many.max() > 0:
        raise ValueError("no ray was measured from both ends")
    mismatch = np.array([pairs.mismatch for pairs in compared])
    mismatch = np.where(many > _ENOUGH * many.max(), mismatch, np.inf)
    best = int(np.argmin(mismatch))
    elsewhere = mismatch[np.abs(places - places[best]) > _ELSEWHERE]
    if not np.isfinite(mismatch[best]) or mismatch[best] > _LARGEST_MISMATCH:
        raise ValueError("rays that should agree do not, wherever the axis is")
    if len(elsewhere) and elsewhere.min() < _CLEARLY * mismatch[best]:
        raise ValueError("opposite rays agree about as well at several places of the axis")
    return float(places[best] * factor), factor


def spread(rays: OppositeRays, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Views and columns that are compared."""
    views, columns, _ = rays.values.shape
    return evenly_spread(views, most), np.arange(0, columns, -(-columns // _COLUMNS))


def _refined(rays: OppositeRays, place: float, limit: float, varying: bool = False) -> tuple[float, float]:
    """The place near this one at which opposite rays agree best, and its standard error, in columns of the rays.

    Only what is ``varying`` with the views may be compared, in which gains of pixels have no part. Else what is linear
    in the column has none: light that drifts, and a flat field that slopes from side to side, make that.
    """
    lines, columns = spread(rays, _VIEWS)
    away = columns - rays.axis - place

    def told(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
        return _varying(values, weight) if varying else _without_ramps(values, weight, away)

    for _ in range(_STEPS):
        pairs, slope = rays.pairs(place, lines, columns), _slope(rays, place, lines, columns)
        change = pairs.opposite - pairs.own
        like = pairs.slope
        slope, change, like = (told(part, pairs.weight) for part in (slope, change, like))
        above, below = pairs.weight * like * change, pairs.weight * like * slope
        if not below.sum() > (_least(pairs.weight, like, slope) if varying else 0):
            raise ValueError("opposite rays show no detail in common")
        step = -float(above.sum() / below.sum())
        place += float(np.clip(step, -_LONGEST, _LONGEST))
        if abs(step) < _SETTLED:
            break
    if abs(step) > 20 * _SETTLED or abs(place) > limit:
        raise ValueError("no single place of the axis was found")
    if pairs.mismatch > _LARGEST_MISMATCH:
        raise ValueError("rays that should agree do not, wherever the axis is")
    distance = np.abs(columns - rays.axis - place)
    error = _jackknife(above, below, distance, 1.0 if rays.seam else 2.0)
    bent = told(rays.bent(place, lines, columns), pairs.weight)
    between = float((pairs.weight * like * bent).sum() / below.sum())
    return place, float(np.hypot(error, _elsewhere(rays, columns) if rays.seam else between))


def _elsewhere(rays: OppositeRays, columns: np.ndarray) -> float:
    """Root of the mean square of the places that the rule of the seam tells between other views, where all are 0."""
    found = []
    for pairs in rays.elsewhere(columns, _SEAMS):
        like, change = (
            _without_ramps(part, pairs.weight, columns - rays.axis)
            for part in (pairs.slope, pairs.opposite - pairs.own)
        )
        below = float((pairs.weight * like**2).sum())
        found.append(float((pairs.weight * like * change).sum()) / below if below > 0 else np.inf)
    return float(np.sqrt(np.mean(np.square(found)))) if len(found) >= _FEWEST_GROUPS else np.inf


def _least(weight: np.ndarray, like: np.ndarray, slope: np.ndarray) -> float:
    """The least sum of the slopes' weighted product that noise alone seldom reaches."""
    size = float((weight * like**2).sum() * (weight * slope**2).sum())
    return _CORRELATED * np.sqrt(_ALIKE * size / max(int(np.count_nonzero(weight)), 1))


def _slope(rays: OppositeRays, place: float, lines: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Change of what opposite rays differ by with the place of the axis, (lines, columns, rows)."""
    ahead, behind = (rays.pairs(place + step, lines, columns) for step in (_APART, -_APART))
    moved = (ahead.opposite - ahead.own) - (behind.opposite - behind.own)
    return np.where((ahead.weight > 0) & (behind.weight > 0), moved / (2 * _APART), 0)


def _varying(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Values (lines, columns, rows) without their mean over lines, in which gains of pixels are."""
    return values - (weight * values).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-300)


def _without_ramps(values: np.ndarray, weight: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Values (lines, columns, rows) without each line's straight line in the column's distance from the axis."""
    light = weight.sum(axis=2)
    value = (weight * values).sum(axis=2) / np.maximum(light, 1e-300)
    total = np.maximum(light.sum(axis=1, keepdims=True), 1e-300)
    from_middle = away - (light * away).sum(axis=1, keepdims=True) / total
    mean = (light * value).sum(axis=1, keepdims=True) / total
    spread = np.maximum((light * from_middle**2).sum(axis=1, keepdims=True), 1e-300)
    ramp = (light * from_middle * value).sum(axis=1, keepdims=True) / spread
    return values - (mean + ramp * from_middle)[..., None]


def _jackknife(above: np.ndarray, below: np.ndarray, distance: np.ndarray, times: float) -> float:
    """Standard error of the quotient of the sums of (lines, columns, rows).

    Each pair is there ``times`` times: in lines far apart, but in columns of the same ``distance`` from the axis.
    """
    errors = []
    lines, rows = (np.flatnonzero(below.any(axis=axes)) for axes in ((1, 2), (0, 1)))
    columns = np.argsort(distance, kind="stable")
    columns = columns[np.asarray(below.any(axis=(0, 2)))[columns]]
    many = len(lines) >= _FEWEST_LINES
    for along, used, most, count in (
        (0 if many else 2, lines if many else rows, _LINE_GROUPS, times if many else 1.0),
        (1, columns, _COLUMN_GROUPS, 1.0),
    ):
        groups = np.array_split(used, min(most, len(used)))
        if len(groups) < _FEWEST_GROUPS:
            continue
        one, two = (
            np.array([values.take(group, along).sum() for group in groups]) for values in (above, below)
        )
        rest = two.sum() - two
        if not (rest > 0).all():
            return np.inf
        without = (one.sum() - one) / rest
        errors.append(float(np.sqrt(count * (len(groups) - 1) * without.var())))
    return max(errors, default=np.inf)
