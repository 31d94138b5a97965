"""Columns of the detector unlike both of their neighbours all the time: noise, or a wrong share of the light."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.scan.axis_offset import LARGEST_SHARE

__all__ = ["apart_columns"]

# Of noise alone a third of the rays lies between both neighbours. Of a column apart fewer than this share are nearer to
# them than the limit, a share of the scan's large values, or of a value of 1, where a tenth of the light is missing.
_BETWEEN, _LIMIT, _FEW_ROWS = 0.2, 0.1, 3
_FEWEST_RAYS, _FEWEST_VIEWS, _FEWEST_COLUMNS = 60, 8, 5
# Of each column, spread over the rows.
_ENOUGH_RAYS = 20_000
# -log of the least light that counts.
_DARKEST = 20.0
# Noise of a column is so many times what the object's detail and its light change from view to view. On 80 clean scans
# of all kinds no column beyond the limit came to more than 1.5.
_NOISE = 2.5
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
        -log(I/I0); NaN where there is none.
    level : float
        What counts as large among them.
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
    if columns < _FEWEST_COLUMNS or views < _FEWEST_VIEWS:
        return bad, doubtful
    # Values of which a hundredth is more than that are no -log(I/I0).
    limit = max(_LIMIT * min(level, 1.0), 0.01 * level) * (1 if rows > 2 else _FEW_ROWS)
    values = values[evenly_spread(rows, max(_FEW_ROWS, _ENOUGH_RAYS // views))]
    apart = np.array([0.0, *(_apart(values, k) for k in range(1, columns - 1)), 0.0])
    # A column beside one that is off may be the outermost of both its neighbours as well.
    most = np.fmax(apart, np.fmax(np.r_[0.0, apart[:-1]], np.r_[apart[1:], 0.0]))
    found = np.flatnonzero((apart > limit) & (apart == most))
    noise = np.array([False, *(_is_noise(values, k, limit) for k in range(1, columns - 1)), False])
    whole, doubt = _arc(azimuth) > _ARC, 1 + LARGEST_SHARE * columns
    for k in found:
        other = 2 * axis - k
        off_axis = abs(other - k) > 2 * doubt and 0 <= other <= columns - 1
        alone = off_axis and not (np.abs(found - other) <= 2 * doubt).any()
        certain = whole and alone or np.nanmedian(values[..., k]) < -limit
        (bad if certain else doubtful)[k] = True
    return bad | noise, doubtful & ~noise


def _apart(values: np.ndarray, k: int) -> float:
    """By how much most rays of a column lie beyond both neighbours; 0 where they do not, or too few tell."""
    one, left, right = values[..., k], values[..., k - 1], values[..., k + 1]
    beyond = np.maximum(one - np.maximum(left, right), np.minimum(left, right) - one)
    told = beyond[np.isfinite(beyond)]
    if len(told) < max(_FEWEST_RAYS, 0.5 * beyond.size):
        return 0.0
    return max(0.0, float(np.quantile(told, _BETWEEN)))


def _is_noise(values: np.ndarray, k: int, limit: float) -> bool:
    """Whether a column changes from view to view by much, and far more than its neighbours with as much light do."""
    one, left, right = (values[..., k + step].astype(np.float64) for step in (0, -1, 1))
    own = np.abs(np.diff(one - 0.5 * (left + right), axis=1))
    told = np.isfinite(own)
    if (
        np.count_nonzero(told) < max(_FEWEST_RAYS, 0.5 * own.size)
        or not (much := np.median(own[told])) > limit
    ):
        return False
    # Photon noise goes with the root of the light; the difference of two has twice the variance of one.
    darker = np.exp(0.5 * np.clip(one - np.minimum(left, right), 0, _DARKEST))[:, 1:]
    usual = np.abs(np.diff(left - right, axis=1)) * darker
    return bool(much > _NOISE * np.median(usual[told]))


def _arc(azimuth: np.ndarray) -> float:
    """The angle that the views cover, in radians."""
    turned = np.sort(np.mod(azimuth, 2 * np.pi))
    return 2 * np.pi - float(np.diff(np.r_[turned, turned[0] + 2 * np.pi]).max())
