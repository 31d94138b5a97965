"""Rays of one circle, and those that ran the same way backwards, for any place of the axis of rotation.

The ray of the view at azimuth t that falls ``j - a`` columns from the axis at ``a`` leaves at the angle g from the
middle of the fan, and is met again ``a - j`` columns from it in the view at t + pi + 2 g. In a parallel beam g is zero.
Both saw the same matter, whatever it is made of, so they agree if the axis is where it is thought to be.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from tomo_polysplat.evenly_spread import evenly_spread

__all__ = ["OppositeRays", "RaysAndOpposites"]

# Gaps between views of more than this many usual ones are not bridged.
_GAP = 2.5
# Radians by which one angle is the same as another.
_SAME_ANGLE = 1e-6
# Columns by which no matter on the detector moves between views that are taken for the same.
_STILL = 0.02
# Views next to the seam of half a turn are evenly spaced to this share of a step.
_EVEN = 0.05
# Columns that the values are smoothed over, so that what lies between columns is as sharp as they are.
_SMOOTH = 1.0
# A ray counts where this share of those that it is smoothed with was measured.
_WHOLE = 0.98
# The 99th percentile of the values that tell how much light a ray has; of larger ones the unit is not known.
_DARK = 6.0


@dataclass(frozen=True)
class RaysAndOpposites:
    """Pairs of rays that ought to be equal.

    Attributes
    ----------
    own, opposite : (lines, columns, rows)
        0 where there is no pair.
    slope : (lines, columns, rows)
        Change of ``opposite - own`` with the place of the axis, told by the own rays alone.
    weight : (lines, columns, rows)
        Inverse of the noise's variance, up to a factor; 0 where there is no pair.
    """

    own: np.ndarray
    opposite: np.ndarray
    slope: np.ndarray
    weight: np.ndarray

    @property
    def mismatch(self) -> float:
        """Share of the variance that opposite rays do not share: 0 where they agree; infinite where there are none."""
        total = float(self.weight.sum())
        if not total > 0:
            return np.inf
        variance = sum(
            float((self.weight * (side - (self.weight * side).sum() / total) ** 2).sum())
            for side in (self.own, self.opposite)
        )
        difference = float((self.weight * (self.own - self.opposite) ** 2).sum())
        return difference / variance if variance > 0 else np.inf


@dataclass(frozen=True)
class OppositeRays:
    """Rows of a detector that went round the object.

    Attributes
    ----------
    values : (views, columns, rows) float64
        -log(I/I0); NaN for rays that are not to be used.
    azimuth : (views,)
        Of the source or the beam, rising, in radians.
    axis : float
        Column of the axis, as told.
    slope : float
        Change of the tangent of the angle g, anticlockwise, per column; 0 in a parallel beam.
    """

    values: np.ndarray
    azimuth: np.ndarray
    axis: float
    slope: float

    def joined(self, factor: int) -> OppositeRays:
        """The same by pixels of which so many columns are joined; the rest at the far end is dropped."""
        if factor == 1:
            return self
        views, columns, rows = self.values.shape
        parts = self.values[:, : columns // factor * factor].reshape(views, -1, factor, rows)
        good = np.isfinite(parts)
        count = good.sum(axis=2)
        mean = np.where(good, parts, 0).sum(axis=2) / np.maximum(count, 1)
        axis = (self.axis - 0.5 * (factor - 1)) / factor
        return OppositeRays(np.where(count, mean, np.nan), self.azimuth, axis, self.slope * factor)

    def pairs(self, offset: float, lines: np.ndarray, columns: np.ndarray) -> RaysAndOpposites:
        """Rays and their opposites if the axis is so many columns above the told one.

        Parameters
        ----------
        offset : float
        lines : (n,) int
            Views, or, at the seam of half a turn, all that there are.
        columns : (m,) int
        """
        return self._compared(
            *(self._at_seam(offset, columns) if self.seam else self._around(offset, lines, columns))
        )

    def _compared(
        self, own: np.ndarray, slope: np.ndarray, opposite: np.ndarray, use: np.ndarray
    ) -> RaysAndOpposites:
        """Pairs with their weights, 0 where they are not to be used."""
        light = [np.exp(self._dark * np.clip(side, 0, _DARK / self._dark)) for side in (own, opposite)]
        weight = np.where(use, 2 / (light[0] + light[1]), 0)
        own, opposite, slope = (np.where(use, part, 0) for part in (own, opposite, slope))
        return RaysAndOpposites(own, opposite, slope, weight)

    def _around(
        self, offset: float, lines: np.ndarray, columns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Rays of these views, slopes, their opposites between two views, and whether there are both."""
        many = len(self.azimuth)
        first, past, gap = self._met(offset, lines, columns)
        second, share = (first + 1) % many, past / np.where(gap > 0, gap, 1)
        usable = (gap > 0) & (gap <= _GAP * self._step)
        (a, use_a), (b, use_b) = self._mirrored(offset, columns, first, second)
        opposite = (1 - share[..., None]) * a + share[..., None] * b
        own, steep = (part[lines][:, columns] for part in (self._smooth, self._steep))
        return own, -2 * steep, opposite, use_a & use_b & usable[..., None] & self._good[lines][:, columns]

    def _met(
        self, offset: float, lines: np.ndarray, columns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(lines, columns) the view before the opposite ray, the angle from it to that, and to the next view."""
        fan = np.arctan(self.slope * (columns - self.axis - offset))
        begin = self.azimuth[0]
        there = begin + np.mod(self.azimuth[lines, None] + np.pi + 2 * fan - begin, 2 * np.pi)
        first = (np.searchsorted(self.azimuth, there - 1e-9) - 1) % len(self.azimuth)
        past = np.mod(there - self.azimuth[first] + 1e-9, 2 * np.pi)
        gap = np.mod(self._gaps[first], 2 * np.pi)
        # A half turn that ends where it began, but for what motors miss: the view at the gap's rim is opposite.
        at_rim = (gap > _GAP * self._step) & (np.minimum(past, gap - past) < self._still)
        past = np.where(at_rim, np.where(past < 0.5 * gap, 0, self._step), past)
        return first, past, np.where(at_rim, self._step, gap)

    def bent(self, offset: float, lines: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """What opposite rays (lines, columns, rows) lack that are taken from the straight line between two views.

        Of how the values bend in the angle, as the views before and after tell. Nothing at the seam of half a turn.
        """
        if self.seam:
            return np.zeros((2, len(columns), self.values.shape[2]))
        first, past, gap = self._met(offset, lines, columns)
        views = [(first + step) % len(self.azimuth) for step in (-1, 0, 1, 2)]
        values, good = zip(*self._mirrored(offset, columns, *views))
        gaps = [np.mod(self._gaps[view], 2 * np.pi)[..., None] for view in views[:3]]
        even = [(step > 0) & (step <= _GAP * self._step) for step in gaps]
        steep = [
            (after - before) / np.where(step > 0, step, 1)
            for before, after, step in zip(values, values[1:], gaps)
        ]
        curved, known = np.zeros(values[0].shape), np.zeros(values[0].shape)
        for k in (0, 1):
            use = even[k] & even[k + 1] & good[k] & good[k + 1] & good[k + 2]
            change = 2 * (steep[k + 1] - steep[k]) / np.maximum(gaps[k] + gaps[k + 1], 1e-12)
            curved, known = curved + np.where(use, change, 0), known + use
        return -0.5 * (past * (gap - past))[..., None] * curved / np.maximum(known, 1)

    def elsewhere(self, columns: np.ndarray, most: int) -> list[RaysAndOpposites]:
        """What is compared at the seam of half a turn, by the same rule between other views: they ought to be equal.

        Parameters
        ----------
        columns : (m,) int
        most : int
            So many places.
        """
        even = np.abs(self._gaps[:-1] / self._step - 1) < _EVEN
        places = np.array(
            [k for k in range(3, len(self.azimuth) - 2) if even[k - 3 : k + 2].all()], dtype=np.int64
        )
        some = places[evenly_spread(len(places), most)]
        steps = range(-3, 3)
        return [
            self._compared(
                *_across(
                    {k: (self._smooth[j + k, columns], self._good[j + k, columns]) for k in steps}, columns
                )
            )
            for j in some
        ]

    def _at_seam(
        self, offset: float, columns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of half a turn: the first and the last view, and what neighbours on both sides of the seam make of them.

        Beyond the seam lie the mirrored views of the other end.
        """
        many = len(self.azimuth)
        place = {}
        views = [np.full((1, len(columns)), many + k) for k in (-3, -2, -1)]
        for k, mirrored in zip((-3, -2, -1), self._mirrored(offset, columns, *views)):
            place[k] = tuple(part[0] for part in mirrored)
        for k in (0, 1, 2):
            place[k] = self._smooth[k, columns], self._good[k, columns]
        return _across(place, columns)

    def _mirrored(
        self, offset: float, columns: np.ndarray, *views: np.ndarray
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Values (lines, columns, rows) of views (lines, columns) at mirrored columns, and whether they are good."""
        most = self.values.shape[1] - 1
        where = 2 * (self.axis + offset) - columns
        left = np.floor(where).astype(int)
        f = where - left
        inside = (where >= 0) & (where <= most)
        # The cubic B-spline of samples that are mirrored at the ends.
        weights = (
            (1 - f) ** 3 / 6,
            (4 - 6 * f**2 + 3 * f**3) / 6,
            (1 + 3 * f + 3 * f**2 - 3 * f**3) / 6,
            f**3 / 6,
        )
        places = [np.abs(left + step) for step in (-1, 0, 1, 2)]
        places = [np.clip(np.where(place > most, 2 * most - place, place), 0, most) for place in places]
        near = np.clip(np.round(where).astype(int), 0, most)

        def summed(some: Any, shape: tuple[int, ...]) -> np.ndarray:
            values = np.zeros((*shape, self.values.shape[2]))
            for place, weight in zip(places, weights):
                values += weight[:, None] * self._spline[some, place]
            return values

        good = [self._good[view, near] & inside[:, None] for view in views]
        many = len(self.values)
        if sum(len(view) for view in views) < many:
            return [(summed(view, view.shape), usable) for view, usable in zip(views, good)]
        # Of few views each one's are made once.
        whole, all_columns = summed(slice(None), (many, len(columns))), np.arange(len(columns))
        return [(whole[view, all_columns], usable) for view, usable in zip(views, good)]

    @cached_property
    def _share(self) -> np.ndarray:
        """How much of what is smoothed together was measured."""
        from scipy.ndimage import gaussian_filter1d

        return gaussian_filter1d(
            np.isfinite(self.values).astype(np.float64), _SMOOTH, axis=1, mode="constant"
        )

    @cached_property
    def _good(self) -> np.ndarray:
        return self._share > _WHOLE

    @cached_property
    def _smooth(self) -> np.ndarray:
        """The values a little smoothed along columns, where they were measured."""
        from scipy.ndimage import gaussian_filter1d

        known = np.where(np.isfinite(self.values), self.values, 0)
        return gaussian_filter1d(known, _SMOOTH, axis=1, mode="constant") / np.maximum(self._share, 1e-3)

    @cached_property
    def _steep(self) -> np.ndarray:
        return np.gradient(self._smooth, axis=1)

    @cached_property
    def _spline(self) -> np.ndarray:
        from scipy.ndimage import spline_filter1d

        return spline_filter1d(self._smooth, 3, axis=1, mode="mirror")

    @cached_property
    def _dark(self) -> float:
        """What the values are multiplied by so that they are attenuations of no more than `_DARK`."""
        usual = float(np.percentile(self._smooth[:: -(-len(self._smooth) // 32)], 99))
        return min(1.0, _DARK / usual) if usual > 0 else 1.0

    @cached_property
    def _gaps(self) -> np.ndarray:
        return np.diff(self.azimuth, append=self.azimuth[0] + 2 * np.pi)

    @cached_property
    def _step(self) -> float:
        # An angle may be there more than once.
        gaps = self._gaps[self._gaps > _SAME_ANGLE]
        return float(np.median(gaps)) if len(gaps) else 0.0

    @property
    def _still(self) -> float:
        """Angle that moves no matter on the detector by more than `_STILL` columns."""
        return 2 * _STILL / self.values.shape[1]

    @property
    def one_pair(self) -> bool:
        """Whether the last view of half a turn in a parallel beam is the first one from behind, and all there is."""
        return not self.slope and bool(abs(np.ptp(self.azimuth) - np.pi) < self._still)

    @cached_property
    def seam(self) -> bool:
        """Whether these are views of half a turn in a parallel beam that begins where `azimuth` does."""
        if self.slope or len(self.azimuth) < 6:
            return False
        steps = np.concatenate([self._gaps[:3], self._gaps[-4:-1], [self._gaps[-1] - np.pi]])
        return bool((np.abs(steps / self._step - 1) < _EVEN).all())


def _across(
    place: dict[int, tuple[np.ndarray, np.ndarray]], columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Views 0 and -1 of six, what their neighbours on both sides make of them, slopes, and whether there are all.

    The views, values and whether they are good (columns, rows) each, are taken for a cubic in the angle.
    """
    own, opposite, use = [], [], []
    for k in (0, -1):
        around = [place[k + step] for step in (-2, -1, 1, 2)]
        own.append(place[k][0])
        opposite.append(sum(w * part for w, (part, _) in zip((-1 / 6, 4 / 6, 4 / 6, -1 / 6), around)))
        use.append(np.logical_and.reduce([place[k][1], *(good for _, good in around)]))
    # Of the four neighbours half lie beyond the seam, or all but half, and with them the view itself.
    slopes = [-np.gradient(own[0], columns, axis=0), np.gradient(own[1], columns, axis=0)]
    return np.stack(own), np.stack(slopes), np.stack(opposite), np.stack(use)
