"""Columns of the detector unlike both of their neighbours all the time: noise, or a wrong share of the light."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.scan.axis_offset import LARGEST_SHARE
from tomo_polysplat.scan.rotation_axis import axis_column, azimuth_of_views
from tomo_polysplat.scan.view_geometry import Geometry

__all__ = ["apart_columns", "columns_not_measured"]

# Of noise alone a third of the rays lies between both neighbours. Of a column apart fewer than this share are nearer to
# them than the limit, a share of the scan's large values, or of a value of 1, where a tenth of the light is missing.
_BETWEEN, _LIMIT, _FEW_ROWS = 0.2, 0.1, 3
_FEWEST_RAYS, _FEWEST_VIEWS, _FEWEST_COLUMNS = 60, 8, 5
# Of each column, spread over the rows; views that tell how large values are.
_ENOUGH_RAYS, _LEVEL_VIEWS = 20_000, 64
# Share of the rays by which a column may fall short of what is asked, and is asked about.
_SLACK = 0.05
# -log of the least light that counts.
_DARKEST = 20.0
# Noise of a column is more than so many times what this share of the rays beside it change from view to view, by the
# object's detail and their light.
_NOISE, _MOST = 1.5, 0.75
# Of independent values those in views next to each other differ by as much as those a share of the scan apart, and as
# those in rows next to each other.
_FAR, _EACH_ANEW = 8, 0.75
# In fewer degrees what is off the axis may stay in its column.
_ARC = np.deg2rad(170)


def apart_columns(
    values: np.ndarray, level: float, axis: float, azimuth: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Columns that no object makes, and those that something round about the axis would make as well.

    What an object has in one column in all views is round about the axis. So it is on both sides of it, or on it; it is
    never brighter than the open beam, and changes from view to view by no more than its light does.

    Parameters
    ----------
    values : (rows, views, columns) array
        -log(I/I0); not finite where there is none.
    level : float
        What counts as large among them; where it is not positive, no column is told of.
    axis : float
        Column on which the axis of rotation falls.
    azimuth : (views,) array
        Angle of the source about the axis in radians.

    Returns
    -------
    bad, doubtful : (columns,) bool array
    """
    rows, views, columns = values.shape
    bad, doubtful = np.zeros((2, columns), bool)
    # Where most rays are brighter than the open field, nothing tells how far from the others a column may be.
    if columns < _FEWEST_COLUMNS or views < _FEWEST_VIEWS or not level > 0:
        return bad, doubtful
    # Values of which a hundredth is more than that are no -log(I/I0).
    limit = max(_LIMIT * min(level, 1.0), 0.01 * level) * (1 if rows > 2 else _FEW_ROWS)
    some = evenly_spread(rows, max(_FEW_ROWS, _ENOUGH_RAYS // views))
    beyond, changes = _likely(values, some, limit)

    def around(k: int) -> np.ndarray:
        return _finite(values[some, :, k - 1 : k + 2])

    apart, noise = np.zeros(columns), np.zeros(columns, bool)
    for k in beyond:
        apart[k] = _apart(around(k))
    for k in changes:
        noise[k] = _is_noise(around(k), limit)
    # A column beside one that is off may be the outermost of both its neighbours as well.
    most = np.fmax(apart, np.fmax(np.r_[0.0, apart[:-1]], np.r_[apart[1:], 0.0]))
    found = np.flatnonzero((apart > limit) & (apart == most))
    whole, doubt = _arc(azimuth) > _ARC, 1 + LARGEST_SHARE * columns
    for k in found:
        other = 2 * axis - k
        off_axis = abs(other - k) > 2 * doubt and 0 <= other <= columns - 1
        alone = off_axis and not (np.abs(found - other) <= 2 * doubt).any()
        certain = whole and alone or np.nanmedian(around(k)[..., 1]) < -limit
        (bad if certain else doubtful)[k] = True
    return bad | noise, doubtful & ~noise


def columns_not_measured(values: np.ndarray, geometry: Geometry) -> np.ndarray:
    """The bad columns of :func:`apart_columns`, (columns,), of a run's rays (views, rows, columns)."""
    views, rows, columns = values.shape
    some = values[evenly_spread(views, _LEVEL_VIEWS), rows // 2]
    some = some[np.isfinite(some)]
    if not some.size:
        return np.zeros(columns, bool)
    level = float(np.percentile(some, 99))
    return apart_columns(values.swapaxes(0, 1), level, axis_column(geometry), azimuth_of_views(geometry))[0]


def _finite(values: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(values), values, np.nan)


def _beyond(left: np.ndarray, one: np.ndarray, right: np.ndarray) -> np.ndarray:
    """By how much values lie beyond both neighbours, above or below; negative between them."""
    return np.maximum(one - np.maximum(left, right), np.minimum(left, right) - one)


def _likely(values: np.ndarray, rows: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Columns that may lie beyond their neighbours, and those that may change, by more than the limit in some rows.

    Rays beyond it are counted, row by row: their quantiles would have to be sorted, of all columns. No more is copied.
    """
    counts = np.zeros((4, values.shape[2] - 2), int)
    for number in rows:
        row = _finite(values[number])
        one, left, right = row[:, 1:-1], row[:, :-2], row[:, 2:]
        beyond = _beyond(left, one, right)
        own = np.abs(np.diff(one - 0.5 * (left + right), axis=0))
        parts = beyond > limit, np.isfinite(beyond), own > limit, np.isfinite(own)
        counts += [np.count_nonzero(part, axis=0) for part in parts]
    far, told, much, compared = counts
    # A little fewer than it takes: the quantile lies between two rays.
    beyond = far > (1 - _BETWEEN - _SLACK) * told
    return np.flatnonzero(beyond) + 1, np.flatnonzero(much > (0.5 - _SLACK) * compared) + 1


def _apart(values: np.ndarray) -> float:
    """By how much most rays of the middle one of three columns lie beyond both others; 0 where too few tell."""
    beyond = _beyond(*np.moveaxis(values, -1, 0))
    told = beyond[np.isfinite(beyond)]
    if len(told) < max(_FEWEST_RAYS, 0.5 * beyond.size):
        return 0.0
    return max(0.0, float(np.quantile(told, _BETWEEN)))


def _is_noise(values: np.ndarray, limit: float) -> bool:
    """Whether the middle one of three columns changes by much, from view to view and row to row, as noise does.

    An edge near the axis changes a column alone, too, but slowly from view to view, or in many rows alike.
    """
    left, one, right = np.moveaxis(values.astype(np.float64), -1, 0)
    own, others = one - 0.5 * (left + right), left - right
    # Photon noise goes with the root of the light; the difference of two has twice the variance of one.
    darker = np.exp(0.5 * np.clip(one - np.minimum(left, right), 0, _DARKEST))
    change = _differences(own, 1)
    told = np.isfinite(change)
    if np.count_nonzero(told) < max(_FEWEST_RAYS, 0.5 * change.size):
        return False
    much, usual = _middle(change), (_differences(others, 1) * darker[:, 1:])[told]
    if not much > max(limit, _NOISE * float(np.quantile(usual, _MOST))):
        return False
    far = _middle(_differences(own, 1, max(2, values.shape[1] // _FAR)))
    rows = _middle(_differences(own, 0)) if len(values) > 1 else np.inf
    return much > _EACH_ANEW * far and rows > _EACH_ANEW * much


def _differences(values: np.ndarray, along: int, step: int = 1) -> np.ndarray:
    """Size of the change to the view, or row, so many steps on."""
    ahead = values[:, step:] if along else values[step:]
    return np.abs(ahead - (values[:, :-step] if along else values[:-step]))


def _middle(values: np.ndarray) -> float:
    told = values[np.isfinite(values)]
    return float(np.median(told)) if told.size else np.inf


def _arc(azimuth: np.ndarray) -> float:
    """The angle that the views cover, in radians."""
    turned = np.sort(np.mod(azimuth, 2 * np.pi))
    return 2 * np.pi - float(np.diff(np.r_[turned, turned[0] + 2 * np.pi]).max())
