"""Pixels that show the same value in every view, which no measurement does: single ones, lines, gaps between tiles."""

from __future__ import annotations

import math

import numpy as np

from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.scan.axis_offset import LARGEST_SHARE

__all__ = ["stuck_pixels"]

# In fewer views a value may come again by chance.
_FEWEST_VIEWS = 8
# A value that working pixels hold in the next view in so many cases, or so many of all pixels always, is what the scan
# holds for air without noise, or for no light. No count comes again so often from five photons a ray on.
_AGAIN, _MANY = 0.2, 0.4
# Rays of some views, each with the next one, that tell what comes again.
_TELLING = 4000
# Beside a stuck pixel values change by so much of the largest where it changes most, or are as far from its own; real
# ones of few different counts may be constant where hardly anything changes. So many of the pixels around must work:
# what lies on the axis looks the same from all around, and so does all that is round about it, where there is no noise.
_CHANGES, _WORKING = 0.1, 0.6
# A value as large, as a share of the largest, is that of rays without light, unless it is as far above what is around.
_OPAQUE, _DARK_AROUND = 0.98, 0.6
# Share of a pixel that the edge of an opaque body covers: it rarely ends between two pixels on both of its sides.
_EDGE = 0.1
# Rows, for each column between both sides of the axis, by which one lies higher if the detector is rolled by 3 degrees.
_ROLLED = 0.05
_AROUND = np.ones((3, 3), bool)


def stuck_pixels(values: np.ndarray, axis: float | None = None) -> np.ndarray:
    """Which pixels are stuck, (rows, columns): constant beside pixels that change, at a value that these never have.

    The zeros of air without noise, which pixels at its border have as well in some views, are not told of.

    Parameters
    ----------
    values : (views, rows, columns) array
        -log(I/I0); values that are not finite are ignored.
    axis : float, optional
        Column on which the axis of rotation falls. Far from it, and with nothing like it on the other side, what is
        dark from all around is no object. Nor is what has no edges, wherever it is.
    """
    views, rows, columns = values.shape
    stuck = np.zeros((rows, columns), bool)
    if views < _FEWEST_VIEWS or columns < 3:
        return stuck
    # A few views leave few pixels to look at in all of them.
    pairs = min(views // 2, max(3, -(-_TELLING // (rows * columns))))
    before = evenly_spread(views - 1, pairs)
    some = values[np.stack([before, before + 1], 1).reshape(-1)]
    first = np.fmax.reduce(some, axis=0)
    same = np.isfinite(first) & (np.isnan(some) | (some == first)).all(axis=0)
    told = same & ~_common(first, some[:, ~same], same)
    place = np.nonzero(told)
    there = values[:, place[0], place[1]]
    enough = np.count_nonzero(np.isfinite(there), axis=0) >= _FEWEST_VIEWS
    told[place] = enough & (np.isnan(there) | (there == first[place])).all(axis=0)
    if not told.any():
        return stuck
    return _among_working(values, np.where(told, first, np.nan), same, axis)


def _common(first: np.ndarray, working: np.ndarray, same: np.ndarray) -> np.ndarray:
    """Where the value is one that working pixels have as well, (rows, columns)."""
    # By chance counts of air have some value in one view, as 0 if they are those of the open beam, hardly in the next.
    before, after = working[::2], working[1::2]
    constant, pixels = np.unique(first[same], return_counts=True)
    shown, counts = np.unique(before, return_counts=True)
    again, times = np.unique(before[before == after], return_counts=True)
    of_shown = counts[np.searchsorted(shown, again)]
    often = np.concatenate(
        [again[(times > 1) & (times > _AGAIN * of_shown)], constant[pixels > _MANY * first.size]]
    )
    return np.isin(first, often) | ~same


def _among_working(values: np.ndarray, held: np.ndarray, same: np.ndarray, axis: float | None) -> np.ndarray:
    """The areas of pixels that held the same value in all views, and around which pixels work; NaN is not told of."""
    from scipy import ndimage

    finite, told = np.isfinite(values), np.isfinite(held)
    largest = float(np.max(values, where=finite, initial=0.0))
    # That of a pixel without light has nothing to do with how much others change.
    working = float(np.max(values, where=finite & ~told, initial=0.0))
    stuck = np.zeros(told.shape, bool)
    for value in np.unique(held[told]):
        areas, _ = ndimage.label(held == value, _AROUND)
        for number, box in enumerate(ndimage.find_objects(areas), 1):
            wider = tuple(slice(max(part.start - 1, 0), part.stop + 1) for part in box)
            area = areas[wider] == number
            around = ndimage.binary_dilation(area, _AROUND) & ~area
            if not around.any():
                continue
            if (~same[wider] & around).sum() < _WORKING * around.sum():
                continue
            beside = values[:, wider[0], wider[1]][:, around & ~same[wider]]
            if not np.isfinite(beside).any():
                continue
            beside = np.where(np.isfinite(beside), beside, np.nan)
            changes = np.fmax.reduce(beside, axis=0) - np.fmin.reduce(beside, axis=0)
            usual = np.nanmedian(beside, axis=0)
            apart = float(np.nanmax(changes, initial=0.0))
            if value >= _OPAQUE * largest and np.nanmedian(usual) > _DARK_AROUND * value:
                continue
            # Where no body can be, to be far from what is beside is enough, though nothing changes there, as in air.
            no_body = value < _OPAQUE * largest or _beside(told, box[0], box[1], axis)
            if no_body:
                apart = max(apart, float(np.nanmax(np.abs(value - usual))))
            most = working if no_body or _sharp(values, *box) else largest
            stuck[wider] |= area & (apart > _CHANGES * most)
    return stuck


def _sharp(values: np.ndarray, rows: slice, columns: slice) -> bool:
    """Whether columns have as much light next to an area without light as one column farther.

    The edge of an opaque body covers a part of a pixel: so much darker is that. Dead columns have no edges.
    """
    sides = []
    for near, far in ((columns.start - 1, columns.start - 2), (columns.stop, columns.stop + 1)):
        if min(near, far) < 0 or max(near, far) >= values.shape[2]:
            continue
        beside, beyond = (np.exp(-values[:, rows, place].astype(np.float64)) for place in (near, far))
        both = np.isfinite(beside) & np.isfinite(beyond)
        sides.append(both.any() and beside[both].mean() >= (1 - _EDGE) * beyond[both].mean())
    return len(sides) > 0 and all(sides)


def _beside(told: np.ndarray, rows: slice, place: slice, axis: float | None) -> bool:
    """Whether an area is off the axis, and as far on the other side of it, as high, are none of the pixels told of.

    An opaque body that looks the same from all around is round about the axis, so it shows on both sides of it.
    """
    if axis is None:
        return False
    columns, doubt = told.shape[1], LARGEST_SHARE * told.shape[1]
    if place.start - doubt <= axis <= place.stop - 1 + doubt:
        return False
    first, last = 2 * axis - (place.stop - 1) - 2 * doubt, 2 * axis - place.start + 2 * doubt
    rolled = 1 + math.ceil(_ROLLED * (max(last, place.stop) - min(first, place.start)))
    level = slice(max(0, rows.start - rolled), rows.stop + rolled)
    return not told[level, max(0, math.floor(first)) : max(0, min(columns, math.ceil(last) + 1))].any()
