"""Rays beside the object: the ends of the detector rows, where they are as flat as air is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Air", "look_for_air"]

# Share of the columns at either end.
_BORDER = 0.04
# Air is this flat along columns and rows, as a share of the scan's span, and this constant from view to view, where
# the source may flicker or fall.
_FLAT, _CONSTANT = 0.01, 0.08
_SURE = 4.0


@dataclass(frozen=True)
class Air:
    """Rays beside the object.

    Attributes
    ----------
    level : float
        What they hold: 0 where the open beam is right.
    error : float
        Standard error of `level`.
    by_view : (2, views)
        Means of both ends of the detector.
    noise : float
        Standard deviation of a ray.
    share : float
        Share of these rays that hold exactly the commonest value.
    """

    level: float
    error: float
    by_view: np.ndarray
    noise: float
    share: float


def look_for_air(values: np.ndarray, span: float) -> Air | None:
    """The rays beside the object, or None where the ends of the rows show something.

    Parameters
    ----------
    values : (rows, views, columns) array
        Without holes.
    span : float
        By how much the values differ in all.
    """
    columns = values.shape[2]
    width = max(2, int(_BORDER * columns))
    if columns < 3 * width:
        return None
    ends = np.stack([values[..., :width], values[..., -width:]]).astype(np.float64)
    noise = float(np.sqrt(0.5 * np.mean(np.diff(ends, axis=3) ** 2)))
    for axes, tolerance in (((1, 2), _FLAT), ((2, 3), _FLAT), ((1, 3), _CONSTANT)):
        means = ends.mean(axis=axes)
        error = noise / np.sqrt(ends[0].size / means[0].size)
        # The largest of so many means is a few standard errors away by chance.
        chance = _SURE + np.sqrt(2 * np.log(means.size))
        if np.abs(means - np.median(means)).max() > max(chance * error, tolerance * span):
            return None
    level = float(np.median(ends.mean(axis=(1, 3))))
    values_there, counts = np.unique(ends.astype(np.float32), return_counts=True)
    return Air(
        level,
        noise / np.sqrt(ends.size) + float(np.std(ends.mean(axis=(1, 2, 3)))),
        ends.mean(axis=(1, 3)),
        noise,
        float(counts.max() / ends.size),
    )
