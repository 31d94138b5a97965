"""Moves of the scanner that opposite rays do not tell, by default: roll, single views, and an axis they miss.

What a fit of a pass leaves of the rays tells them. The questions of the run ask for that fit as well; a large detector
is fitted by joined pixels. If there are moves, three or four more fits find them to hundredths of a pixel, and rays
held out of these have to confirm them.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from tomo_polysplat.fit.move_sums import move_sums
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.nuisances.alignment import Alignment
from tomo_polysplat.nuisances.move_estimate import shifts_of_views, whole_moves
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.coarse import LEAST_PASSES, coarse_problem, coarse_settings
from tomo_polysplat.plan.fall_of_misfits import fall_of_misfits
from tomo_polysplat.plan.first_look import Look
from tomo_polysplat.plan.fit_options import FitOptions
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.plan.preparation import lab_of
from tomo_polysplat.ranks import ALONE, current_ranks, led_by
from tomo_polysplat.scan.gauges import effects, view_gauge
from tomo_polysplat.scan.moved_rays import falls_of
from tomo_polysplat.scan.moves import Scanner, moved_geometry

__all__ = ["is_joined", "realigned"]

logger = logging.getLogger(__name__)

# Moves of the whole scanner that are looked for, with those of single views.
_WHOLE = ("u", "roll")
# One is looked for where the object leaves this share of what it does (`scan.gauges.effects`), and the axis where
# it is known no better than this, in pixels, by `plan.axis`: that error is the smaller one then.
_TOLD, _AXIS_KNOWN = 0.1, 0.02
# Moves of more than this, in pixels of what is seen, beyond so many standard errors are looked for, and views shifted
# by more than that; once any is, all that are sure to so many standard errors are made.
_LEAST, _SURE, _LEAST_OF_VIEWS, _FOUND = 0.01, 2.5, 0.05, 2.0
# Roll, and shifts along columns, are told by what rows differ by in the fit: held-out rays must show so much of that.
_ROWS = 0.5
# They are kept where the misfit of the same held-out rays falls by more than this, and by so many standard errors.
_BETTER, _SURELY_BETTER = 0.01, 2.5
# Fits, their passes, and the change, in pixels, after which the moves are known.
_ROUNDS, _PASSES, _SETTLED = 5, 1.0, 0.02
# A larger detector is asked by joined pixels, of which at least so many columns are left: moves show to hundredths.
_COLUMNS = 256
# A step may be so many times what a fit says. An axis stays if less than this of a step is gained: half acquisitions
# gained 0.4, and went a pixel astray; whole turns gain 0.9 and more.
_FARTHEST, _GAINED = 2.0, 0.6


@dataclass(frozen=True)
class _Left:
    """What a fit says is still to be moved.

    Attributes
    ----------
    whole : (moves,) array
        Moves of the whole scanner, those alone that are sure, or were made before.
    views : (views, 2) array
        Shifts of single views, likewise.
    pixels : float
        The largest of them, as seen.
    clear : bool
        Whether any is large, and sure, enough to be looked for.
    held_out : (views,) array
        Misfits of the rays held out of the fit.
    """

    whole: np.ndarray
    views: np.ndarray
    pixels: float
    clear: bool
    held_out: np.ndarray


def realigned(
    problem: Problem,
    axis: Answer,
    first: Look | None,
    options: FitOptions,
    report: Callable[[float, str], Any],
) -> Answer:
    """Where the scanner stood: a fit of one pass tells whether it moved, and a few more find out by how much.

    Parameters
    ----------
    problem : Problem
        As told.
    axis : Answer
        Of `plan.axis.find_axis`, with which it begins.
    first : Look or None
        By the scanner with that axis. Nothing is asked without one, but of a large detector, by joined pixels.
    options : FitOptions
    report : callable
        Gets the share done, none, and words.

    Returns
    -------
    Answer
        That of the axis, where there is no more to move, or where held-out rays do not confirm it.
    """
    joined = is_joined(problem)
    if (options.settings.passes or math.inf) < LEAST_PASSES if joined else first is None:
        return axis
    report(0.0, "alignment")
    try:
        coarse, pixel = _joined(problem)
        start = _times(_tensors(axis.value), 1 / pixel)
        fits = _Realignment(coarse, axis, options)
        if first is not None and not joined and not fits.is_clear(first, start):
            logger.info("Alignment: no more has moved")
            return axis
        # A detector of joined pixels is small, and other processes may still be starting: a pass would wait for them.
        with led_by(ALONE) if joined else nullcontext():
            moved, misfits = fits.moved(start)
    except Exception as broken:
        # Processes that share the steps may be left behind by one that fails.
        if current_ranks().count > 1:
            raise
        logger.warning("A short fit failed, so the scanner stays where it is: %r", broken)
        return axis
    if all(name in start and torch.equal(value, start[name]) for name, value in moved.items()):
        logger.info("Alignment: no more has moved")
        return axis
    moved = _times(moved, pixel)
    moves = {name: value.tolist() for name, value in moved.items() if bool(value.any())}
    words, (better, error) = Alignment.told(moves), fall_of_misfits(misfits[0], misfits[-1], 0.0)
    share = f"misfit of held-out rays falls by {better:.1%} (standard error {error:.1%})"
    if not better > max(_BETTER, _SURELY_BETTER * error):
        logger.info("Alignment: not moved, %s; the %s", words, share)
        return axis
    logger.warning("The scanner stood elsewhere: %s. align=False leaves it.", words)
    evidence = {**axis.evidence, "better": better, "better_error": error}
    return Answer(moves, f"{words}; the {share}", Status.ASKED, evidence)


def is_joined(problem: Problem) -> bool:
    """Whether the detector is so large that it is asked by joined pixels."""
    return problem.geometry.columns // _COLUMNS >= 2


def _joined(problem: Problem) -> tuple[Problem, np.ndarray]:
    """The problem by joined pixels where these are many, and how many columns and rows are joined."""
    if not is_joined(problem):
        return problem, np.ones(2)
    factor = problem.geometry.columns // _COLUMNS
    coarse, rows = coarse_problem(problem, factor)
    return coarse, np.array([factor, rows], float)


def _times(moves: Mapping[str, torch.Tensor], pixel: np.ndarray) -> dict[str, torch.Tensor]:
    """Moves in other pixels; angles and what is in per cent stay."""
    by = {"u": pixel[0], "v": pixel[1], "views": torch.from_numpy(pixel)}
    return {name: value * by.get(name, 1.0) for name, value in moves.items()}


class _Realignment:
    """Fits of a pass or two, and what they say of the scanner."""

    def __init__(self, problem: Problem, axis: Answer, options: FitOptions) -> None:
        self.problem, self.options = problem, options
        self.scanner = Scanner(problem.geometry, problem.axis)
        whole = ["u"] if problem.geometry.planar else list(_WHOLE)
        if axis.evidence.get("error", math.inf) <= _AXIS_KNOWN:
            whole.remove("u")
        found = effects(self.scanner, whole, 1.0)
        self.names = tuple(name for name, effect in found.items() if effect.told >= _TOLD)
        self.seen = np.array([found[name].pixels for name in self.names])
        # Those that were moved: what is left of them is made as far as it is told, sure or not.
        self.made = np.zeros(len(self.names), bool)
        self.gauge = view_gauge(self.scanner).numpy()
        self.settings = replace(coarse_settings(options.settings), passes=_PASSES)

    def is_clear(self, look: Look, values: dict[str, torch.Tensor]) -> bool:
        """Whether a fit says that the scanner moved from where these moves have it."""
        return self._left(look.gaussians, look.lab.scene, look.lab.rays, values).clear

    def moved(self, start: dict[str, torch.Tensor]) -> tuple[dict[str, torch.Tensor], list[np.ndarray]]:
        """Where the scanner stood, and the misfits of held-out rays of fits by it, the first as it is."""
        values, misfits = start, list[np.ndarray]()
        before: tuple[np.ndarray, np.ndarray] | None = None
        for number in range(_ROUNDS):
            left = self._left(*self._fitted(values), values)
            misfits.append(left.held_out)
            if not (number or left.clear) or not left.pixels or number == _ROUNDS - 1:
                break
            if before is not None and self._hides_axis(left.whole, *before):
                values, before = self._without_axis(values, start), None
                continue
            step = left.whole if before is None else _secant(left.whole, *before)
            before, self.made = (left.whole, step), self.made | (step != 0)
            values = self._stepped(values, step, left.views)
            if number and left.pixels < _SETTLED:
                break
        return values, misfits

    def _hides_axis(self, left: np.ndarray, left_before: np.ndarray, step: np.ndarray) -> bool:
        """Whether the object takes the place of most of a step of the axis, as it does where one half of it is seen."""
        if "u" not in self.names:
            return False
        at = self.names.index("u")
        return bool(step[at] != 0 and (left_before[at] - left[at]) / step[at] < _GAINED)

    def _without_axis(
        self, values: dict[str, torch.Tensor], start: dict[str, torch.Tensor]
    ) -> dict[str, torch.Tensor]:
        """The values with the axis where it was at the start, where it now stays."""
        stay = np.array([name != "u" for name in self.names])
        self.names = tuple(name for name in self.names if name != "u")
        self.seen, self.made = self.seen[stay], self.made[stay]
        rest = {name: value for name, value in values.items() if name != "u"}
        return rest | {name: value for name, value in start.items() if name == "u"}

    def _left(
        self, gaussians: Gaussians, scene: FitScene, rays: Rays, values: dict[str, torch.Tensor]
    ) -> _Left:
        """What a fit says is still to be moved."""
        falls = falls_of(self.scanner, values, (*self.names, "u", "v"))
        sums = move_sums(gaussians, scene, rays, self.settings, falls)
        normal, told, many = sums.normal, sums.told, len(self.names)
        # Of an object that is the same in all rows these differ by noise, which told shifts of 13 rows.
        alike = sums.rows < _ROWS
        which = [k for k, name in enumerate(self.names) if name == "u" or not alike]
        moves = whole_moves(normal.sum(axis=0), told.sum(axis=0), which).among(many, which)
        if alike:
            along = np.arange(many + 3) != many + 1
            normal, told = normal * along * along[:, None], told * along
        size, error = np.abs(moves.value) * self.seen, moves.error * self.seen
        whole = np.where((size > _FOUND * error) | self.made, moves.value, 0.0)
        told = told - normal[..., :many] @ whole
        single = slice(many, many + 3)
        shifts = shifts_of_views(normal[:, :, single, single], told[:, :, single], self.gauge)
        rms = np.sqrt(np.mean(shifts**2, axis=0))
        pixels = float(max((np.abs(whole) * self.seen).max(initial=0.0), rms.max()))
        clear = bool((size > _LEAST + _SURE * error).any() or (rms > _LEAST_OF_VIEWS).any())
        logger.debug(
            "left: %s of errors %s, views %s px, rows %.2f", moves.value, moves.error, rms, sums.rows
        )
        return _Left(whole, shifts, pixels, clear, sums.held_out)

    def _stepped(
        self, values: dict[str, torch.Tensor], whole: np.ndarray, shifts: np.ndarray
    ) -> dict[str, torch.Tensor]:
        """Values of the moves after a step; those that are 0 are left out."""
        values = dict(values)
        for name, by in [*zip(self.names, whole), ("views", shifts)]:
            if np.any(by):
                values[name] = values.get(name, 0.0) + torch.as_tensor(by, dtype=torch.float64)
        return values

    def _fitted(self, values: dict[str, torch.Tensor]) -> tuple[Gaussians, FitScene, Rays]:
        """A fit by the scanner as it stood."""
        # What is told of one start is not kept for another.
        geometry = moved_geometry(self.scanner, values) if values else self.problem.geometry
        options = replace(self.options, settings=self.settings)
        # Asked of the scanner as told: its answer may be a warning, and rolled rays of few rows leave the volume.
        self.problem.closed(self.options.device)
        lab = lab_of(self.problem.seen_by(geometry, nearly=True), Plan(), options)
        return lab.trial(self.settings).gaussians, lab.scene, lab.rays


def _secant(left: np.ndarray, left_before: np.ndarray, step: np.ndarray) -> np.ndarray:
    """How far to go, of what was left before a step and after it: the object hides a part of a move from each fit."""
    gained = left_before - left
    with np.errstate(divide="ignore", invalid="ignore"):
        times = np.where((left_before != 0) & (gained * step > 0), step / gained, 1.0)
    return left * np.clip(times, 1.0, _FARTHEST)


def _tensors(moves: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    return {name: torch.tensor(value, dtype=torch.float64) for name, value in moves.items()}
