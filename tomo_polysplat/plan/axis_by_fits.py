"""Where the axis of rotation was, by short fits: rays held out of one are explained best where the axis is right.

Opposite rays tell it where there are any: not in helical and laminographic scans, nor in most half cones, and roughly
where half a turn has few views. These fits need none, but take longer.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from tomo_polysplat.fit.loss import misfit_by_view
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import batches_around
from tomo_polysplat.plan.coarse import coarse_problem, coarse_settings
from tomo_polysplat.plan.fall_of_misfits import fall_of_misfits
from tomo_polysplat.plan.fit_options import FitOptions
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.plan.preparation import lab_of
from tomo_polysplat.plan.trial import views_of_short_steps
from tomo_polysplat.ranks import ALONE, led_by
from tomo_polysplat.scan.axis_offset import LARGEST_SHARE, AxisOffset
from tomo_polysplat.scan.gauges import effects
from tomo_polysplat.scan.moves import Scanner, moved_geometry
from tomo_polysplat.start.initial import FEW_VIEWS

__all__ = ["FitsByAxis", "axis_by_fits", "fits_that_show", "joined_columns"]

# The object has to leave this share of a move (`scan.gauges.effects`): a quarter of a turn leaves 0.10, and fits tell
# the axis; 60 degrees leave 0.04 to 0.06, and they do not.
_TOLD = 0.08
# Columns of joined pixels at least, and at most where they are joined less to know the axis better.
_FEWEST_COLUMNS, _MOST_COLUMNS = 24, 256
# Passes of a fit, or so many steps where these are more.
_PASSES, _STEPS, _STEPS_PLANAR = 1.0, 120, 240
# Places beside each other at first, in joined columns. They come closer until what a wedge leaves is half of how well
# the axis is to be known, in so many rounds at most.
_APART, _WEDGE, _ROUNDS = 0.4, 6.0, 12
# Misfits rise surely by so many standard errors.
_SURE = 2.5
# Joined columns by which a detector has to be off for two fits to show it: 0.05 of one of eight columns did not.
_SHOWN = 0.1
# Groups of views, each left out once, and views that tell anything.
_GROUPS, _FEWEST_VIEWS = 12, 24


class FitsByAxis:
    """Short fits by joined pixels, with the axis of rotation here and there.

    Parameters
    ----------
    problem : Problem
        As told.
    factor : int
        Columns that are joined.
    options : FitOptions
    """

    def __init__(self, problem: Problem, factor: int, options: FitOptions) -> None:
        self.factor = factor
        self._problem, _ = coarse_problem(problem, factor)
        # Asked once, as its answer may be a warning.
        self._problem.closed(options.device)
        self._scanner = Scanner(self._problem.geometry, problem.axis)
        settings = replace(coarse_settings(options.settings), passes=_PASSES)
        self._options = replace(options, settings=settings, time_budget=None)
        self._made: dict[float, np.ndarray] = {}

    def misfits(self, columns: float) -> np.ndarray:
        """(views,) mean misfit of the rays held out of a fit whose detector is so many columns off; NaN without any."""
        if columns not in self._made:
            # The pixels are few: other processes would wait more than they help.
            with led_by(ALONE):
                self._made[columns] = self._fitted(columns)
        return self._made[columns]

    def _fitted(self, columns: float) -> np.ndarray:
        problem, settings = self._problem, self._options.settings
        if columns:
            off = {"u": torch.tensor(columns / self.factor, dtype=torch.float64)}
            problem = problem.seen_by(moved_geometry(self._scanner, off), nearly=True)
        lab = lab_of(problem, Plan(), self._options)
        if not len(lab.seeds()):
            return np.full(problem.geometry.views, np.nan)
        steps = _STEPS_PLANAR if problem.planar else _STEPS
        passes = steps * views_of_short_steps(lab.plan, problem) / problem.geometry.views
        settings = replace(settings, passes=max(_PASSES, passes))
        gaussians, found = lab.trial(settings).gaussians, []
        with torch.no_grad():
            for views, measured, _, aside in batches_around(lab.rays, len(lab.rays.views)):
                predicted, _ = lab.scene.projections(gaussians, views)
                found.append(misfit_by_view(predicted, measured, aside, settings))
        return torch.cat(found).double().cpu().numpy()


def fits_that_show(
    problem: Problem, columns: float, options: FitOptions, made: FitsByAxis | None
) -> FitsByAxis:
    """Fits by the largest pixels that show a move by so many columns, or by the smallest; those ``made`` if they do."""
    if made is not None and abs(columns) >= _SHOWN * made.factor:
        return made
    factors = joined_columns(problem.geometry.columns)
    shown = [factor for factor in factors if abs(columns) >= _SHOWN * factor]
    return FitsByAxis(problem, shown[0] if shown else factors[-1], options)


def joined_columns(columns: int) -> list[int]:
    """How many columns are joined, from the most to the fewest."""
    most = 1
    while columns // (2 * most) >= _FEWEST_COLUMNS:
        most *= 2
    fewest = 1 if columns < 4 * _FEWEST_COLUMNS else max(2, -(-columns // _MOST_COLUMNS))
    return [most >> k for k in range(most.bit_length()) if most >> k >= min(fewest, most)]


def axis_by_fits(
    problem: Problem, near: float, known: float, options: FitOptions
) -> tuple[AxisOffset, FitsByAxis | None]:
    """By how many columns the detector was off, of short fits, and the last of these.

    Parameters
    ----------
    problem : Problem
        As told.
    near : float
        Where it may be, in columns.
    known : float
        How well it is to be known, in columns, if need be by smaller pixels.
    options : FitOptions

    Notes
    -----
    The place is the vertex of a parabola through the mean misfits of three places, the middle one of which has the
    least. Its standard error is the jackknife's over groups of neighbouring views (Efron 1982).
    """
    scanner = Scanner(problem.geometry, problem.axis)
    if problem.geometry.views < FEW_VIEWS:
        return AxisOffset(0.0, np.inf, f"fewer than {FEW_VIEWS} views do not tell"), None
    if effects(scanner, ["u"], 1.0)["u"].told < _TOLD:
        return AxisOffset(0.0, np.inf, "the object can take the place of a move"), None
    first, *others = joined_columns(problem.geometry.columns)
    farthest = LARGEST_SHARE * problem.geometry.columns
    fits = FitsByAxis(problem, first, options)
    found = _least(fits, near, known, farthest)
    for factor in others:
        if found.doubt or found.error <= known:
            break
        fits = FitsByAxis(problem, factor, options)
        better = _least(fits, found.columns, known, farthest)
        found = better if better.error < found.error else found
    if abs(found.columns) > farthest:
        return AxisOffset(0.0, np.inf, f"by fits it is more than {farthest:.3g} columns away"), fits
    return found, fits


def _least(fits: FitsByAxis, near: float, known: float, farthest: float) -> AxisOffset:
    """Where the misfit is least, near this place or in the direction in which it falls."""
    middle, apart = near, _APART * fits.factor
    while not (three := _Three(fits, middle, apart)).sure:
        if three.views < _FEWEST_VIEWS:
            return AxisOffset(0.0, np.inf, "too few views have rays that are held out of fits")
        middle, apart = three.place, 2 * apart
        if max(abs(middle), apart) > farthest:
            return AxisOffset(0.0, np.inf, f"fits explain the rays as well {farthest:.3g} columns away")
    found = three.vertex()
    if apart == _APART * fits.factor and abs(found.columns - middle) <= found.error + 0.5 * known:
        return found
    # Misfits fall like a wedge and not like a parabola, whose vertex is then off by a twelfth of the distance, and by
    # more beyond half of it. But fits at closer places differ less, at last no more than by chance.
    finest, place = min(0.5 * _APART * fits.factor, _WEDGE * known), found.columns
    for _ in range(_ROUNDS):
        far = abs(place - middle) > 0.5 * apart
        if not far and apart <= finest:
            break
        middle, apart = place, apart if far else 0.5 * apart
        three = _Three(fits, middle, apart)
        if three.place == middle and not three.sure:
            break
        found = three.vertex() if three.sure else found
        place = found.columns if three.sure else three.place
    return found


class _Three:
    """Misfits at three places, equally far apart.

    Attributes
    ----------
    views : int
        That have rays held out of all three fits.
    place : float
        The one of the least misfit.
    sure : bool
        Whether that is the middle one, and the misfit rises surely on both sides.
    """

    def __init__(self, fits: FitsByAxis, middle: float, apart: float) -> None:
        self._middle, self._apart = middle, apart
        places = (middle - apart, middle, middle + apart)
        misfits = np.stack([fits.misfits(place) for place in places])
        self._misfits = misfits[:, np.isfinite(misfits).all(axis=0)]
        self.views = self._misfits.shape[1]
        self.place, self.sure = middle, False
        if self.views < _FEWEST_VIEWS:
            return
        self.place = places[int(np.argmin(self._misfits.mean(axis=1)))]
        rises = [fall_of_misfits(self._misfits[side], self._misfits[1], 0.0) for side in (0, 2)]
        self.sure = all(rise > _SURE * error for rise, error in rises)

    def vertex(self) -> AxisOffset:
        """Of the parabola through the misfits, with its standard error."""
        groups = np.array_split(np.arange(self.views), _GROUPS)
        of_each = np.stack([self._misfits[:, part].sum(axis=1) for part in groups])
        count = np.array([len(part) for part in groups])
        without = (of_each.sum(axis=0) - of_each) / (count.sum() - count)[:, None]
        vertex, *others = (_of_three(*three) for three in (of_each.sum(axis=0), *without))
        error = float(np.sqrt((len(groups) - 1) * np.var(others)))
        # No farther than the places: beyond them it would be a guess.
        place = self._middle + self._apart * float(np.clip(vertex, -1.0, 1.0))
        return AxisOffset(place, self._apart * error)


def _of_three(before: float, there: float, behind: float) -> float:
    """Where the parabola through the values at -1, 0 and 1 has its least; if it has none, the end that is smaller."""
    bend = before - 2 * there + behind
    return 0.5 * (before - behind) / bend if bend > 0 else np.sign(before - behind)
