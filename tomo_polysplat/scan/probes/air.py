"""Rays beside the object: the ends of the detector rows, where they are as flat as air is.

What they hold instead of 0 is the open beam's, if it is the same in all of them: the flats were taken at another
exposure. It may also be matter around the object, such as foam, a bath or a holder. Then it is as uneven as matter that
wide is at least: the chord of a cylinder changes from column to column, the less so the wider the cylinder is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Air", "look_for_air"]

# Share of the columns at either end, and that which is looked at for more of the same.
_BORDER, _MOST = 0.04, 0.35
# Air is this flat along columns and rows, as a share of the scan's span, and this constant from view to view, where
# the source may flicker or fall.
_FLAT, _CONSTANT = 0.01, 0.08
_SURE = 4.0
# Blocks of rows that are looked at one by one for where the object begins.
_BLOCKS = 8
# A level that is less of the span changes nothing that is seen; one that is even differs by less of itself.
_WORTH, _EVEN = 1e-3, 0.1
# Matter around is as wide as a run can hold, in half widths of view or volume (`Settings.surroundings`), or as it would
# be with this share of the object's density. Nothing is wider than the last.
_HELD, _AS_DENSE, _WIDEST = 2.0, 0.1, 4.0


@dataclass(frozen=True)
class Air:
    """Rays beside the object.

    Attributes
    ----------
    level : float
        What they hold, by the mean of their light: 0 where the open beam is right.
    error : float
        Standard error of `level`: by the noise, and by all that differs in these rays but from view to view alike.
    sure : bool
        Whether all of them hold `level`, beyond their noise, as they do of a beam that differs from the flats' and of
        no matter around.
    by_view : (2, views)
        Means of both ends of the detector.
    noise : float
        Standard deviation of a ray.
    share : float
        Share of these rays that hold exactly the commonest value.
    """

    level: float
    error: float
    sure: bool
    by_view: np.ndarray
    noise: float
    share: float


def look_for_air(values: np.ndarray, span: float, axis: float, reach: float) -> Air | None:
    """The rays beside the object, or None where the ends of the rows show something.

    Parameters
    ----------
    values : (rows, views, columns) array
        Without holes.
    span : float
        By how much the values differ in all.
    axis, reach : float
        Column of the axis of rotation, and columns from there to a side of the volume.
    """
    columns = values.shape[2]
    width = max(2, int(_BORDER * columns))
    if columns < 3 * width:
        return None
    ends = np.stack([values[..., :width], values[..., -width:]]).astype(np.float64)
    noise = float(np.sqrt(0.5 * np.mean(np.diff(ends, axis=3) ** 2)))
    of_pixel = _scatter_of_pixels(ends.mean(axis=2))
    for axes, tolerance in (((1, 2), _FLAT), ((2, 3), _FLAT), ((1, 3), _CONSTANT)):
        means = ends.mean(axis=axes)
        pixels = np.prod([ends.shape[axis] for axis in axes if axis != 2])
        error = np.hypot(noise / np.sqrt(ends[0].size / means[0].size), of_pixel / np.sqrt(pixels))
        # The largest of so many means is a few standard errors away by chance.
        chance = _SURE + np.sqrt(2 * np.log(means.size))
        if np.abs(means - np.median(means)).max() > max(chance * error, tolerance * span):
            return None
    values_there, counts = np.unique(ends.astype(np.float32), return_counts=True)
    light = _Light(values, width)
    return Air(
        light.level,
        light.error,
        abs(light.level) > _WORTH * span and light.is_beam(span, axis, reach),
        ends.mean(axis=(1, 3)),
        noise,
        float(counts.max() / ends.size),
    )


def _scatter_of_pixels(means: np.ndarray) -> float:
    """Standard deviation of what pixels (ends, rows, columns) hold in the mean of the views, as of gains and flats.

    Matter that varies from column to column, or from row to row, has no part in it; one row does not tell.
    """
    bends = np.diff(np.diff(means, axis=2), axis=1)
    return float(np.sqrt(np.mean(bends**2)) / 2) if bends.size else 0.0


class _Light:
    """The light of rays beside the object, from the ends of the rows to where the object begins.

    The mean of the light has no bias from the noise, that of its logarithm has.

    Parameters
    ----------
    values : (rows, views, columns) array
    width : int
        Columns at either end that are air.
    """

    def __init__(self, values: np.ndarray, width: int) -> None:
        rows, views, columns = values.shape
        most = max(width, int(_MOST * columns))
        # From the ends inwards.
        sides = [np.exp(-values[..., :most]), np.exp(-values[..., : -most - 1 : -1])]
        ends = np.concatenate([side[..., :width] for side in sides], axis=2, dtype=np.float64)
        of_view = ends.mean(axis=(0, 2))
        steps = [np.mean(np.diff(side[..., :width].astype(np.float64), axis=2) ** 2) for side in sides]
        self._noise = float(np.sqrt(0.5 * np.mean(steps)) / of_view.mean())
        wide = [self._width(side, of_view, ends, width) for side in sides]
        kept = [side[..., :n] for side, n in zip(sides, wide)]
        self._columns = np.concatenate([np.arange(wide[0]), columns - 1 - np.arange(wide[1])])
        by_side = -np.log([side.mean(axis=(0, 2), dtype=np.float64) for side in kept])
        by_view = np.average(by_side, axis=0, weights=wide)
        self.level = float(by_view.mean())
        # (rows, columns): what a pixel holds in the mean of the views.
        self._pixels = -np.log(np.concatenate([side.mean(axis=1, dtype=np.float64) for side in kept], axis=1))
        self._views = views
        self._noise_of_level = self._of_pixel(self._pixels - self._pixels.mean()) / np.sqrt(self._pixels.size)
        # What differs besides: the sides, also from view to view, and the mean of the views and most of them.
        apart, few = by_side[0] - by_side[1], sum(1 / n for n in wide) / rows
        gap = apart.mean() ** 2 - self._of_pixel(self._pixels - self._pixels.mean()) ** 2 * few
        comes = apart.var() - self._noise**2 * few * (1 + _SURE * np.sqrt(2 / views))
        some = abs(self.level - np.median(by_view)) - 2 * by_view.std() / np.sqrt(views)
        self._uneven = float(np.sqrt(max(gap, 0.0) / 4 + max(comes, 0.0) + max(some, 0.0) ** 2))
        self.error = float(np.hypot(self._noise_of_level, self._uneven))

    def _width(self, side: np.ndarray, of_view: np.ndarray, ends: np.ndarray, width: int) -> int:
        """How many columns of a side hold the same as its end, in all views and all parts of the rows."""
        rows, views, columns = side.shape
        first = np.linspace(0, rows, min(rows, _BLOCKS) + 1).astype(int)
        each = np.diff(first)[:, None]
        blocks = (
            np.add.reduceat(side, first[:-1], axis=0, dtype=np.float64) / each[..., None] / of_view[:, None]
        )
        means = blocks.mean(axis=1)
        noise = self._noise * np.sqrt(1 / each + views / ends.size)
        chance = _SURE + np.sqrt(2 * np.log(len(each) * views))
        alike = (np.abs(blocks / means[:, None] - 1).max(axis=1) < chance * noise).all(axis=0)
        pixels = ends.mean(axis=1)
        of_pixel = max(float(np.std(pixels / pixels.mean())), self._noise / np.sqrt(views))
        far = (_SURE + np.sqrt(2 * np.log(len(each)))) * of_pixel / np.sqrt(each)
        whole = np.average(means, axis=0, weights=each[:, 0])
        for column in range(width, columns):
            outer = whole[:column].mean()
            off = np.abs(means[:, column] / outer - 1) > far[:, 0]
            edge = abs(whole[column] / outer - 1) > _SURE * of_pixel * np.sqrt((1 + 1 / column) / rows)
            if not alike[column] or off.any() or edge:
                return column
        return columns

    def _of_pixel(self, left: np.ndarray, parameters: int = 1) -> float:
        """Standard deviation of what a pixel holds: by what is `left` of all of them, and by the noise at least."""
        scatter = np.sqrt(np.sum(left**2) / max(left.size - parameters, 1))
        return float(max(scatter, self._noise / np.sqrt(self._views)))

    def is_beam(self, span: float, axis: float, reach: float) -> bool:
        """Whether the level is beyond its error, and as even as no cylinder around that matters."""
        if abs(self.level) <= max(_SURE * self._noise_of_level, self._uneven / _EVEN):
            return False
        across = np.abs(self._columns - axis)
        half = max(float(across.max()) + 0.5, reach)
        wide = (
            _WIDEST if abs(self.level) > _WIDEST * _AS_DENSE * span else abs(self.level) / (_AS_DENSE * span)
        )
        wide = max(_HELD, wide) * half
        chord = np.sqrt(wide**2 - across**2)
        # 1 where the level is such a cylinder's, 0 where it is even.
        shape = np.broadcast_to(self.level * (chord / chord.mean() - 1), self._pixels.shape)
        pixels, squares = self._pixels - self._pixels.mean(), float(np.sum(shape**2))
        like = float(np.sum(shape * pixels)) / squares
        error = self._of_pixel(pixels - like * shape, parameters=2) / np.sqrt(squares)
        return abs(like) < max(_EVEN, _SURE * error) and abs(like) + _SURE * error < 1
