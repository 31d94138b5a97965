"""Moves of the scanner that opposite rays do not tell, by default: roll, tilt, single views, and an axis they miss.

What a fit of a pass leaves of the rays tells them. Where there are any, two or three more fits find them to hundredths
of a pixel, and rays held out of these have to confirm them.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
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
from tomo_polysplat.nuisances.alignment_search import worth_it
from tomo_polysplat.nuisances.move_estimate import shifts_of_views, whole_moves
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.axis import axis_of
from tomo_polysplat.plan.coarse import coarse_settings
from tomo_polysplat.plan.first_gaussians import first_gaussians
from tomo_polysplat.plan.first_volume import first_volume
from tomo_polysplat.plan.means import Means
from tomo_polysplat.plan.model import rays_of, scene_of
from tomo_polysplat.plan.order import plan_from_start
from tomo_polysplat.plan.trial import fitted_shortly
from tomo_polysplat.ranks import current_ranks
from tomo_polysplat.scan.gauges import effects, view_gauge
from tomo_polysplat.scan.moved_rays import falls_of
from tomo_polysplat.scan.moves import Scanner, moved_geometry

__all__ = ["realigned"]

logger = logging.getLogger(__name__)

# Moves of the whole scanner that are looked for, with those of single views.
_WHOLE = ("u", "roll")
# One is looked for where the object leaves this share of what it does (`scan.gauges.effects`), and the axis where
# opposite rays tell it no better than this, in pixels: their error is the smaller one then.
_TOLD, _AXIS_KNOWN = 0.1, 0.02
# Moves of more than this, in pixels of what is seen, beyond so many standard errors are looked for; once any is, all
# that are sure to so many are made.
_LEAST, _SURE, _FOUND = 0.03, 4.0, 2.0
# Fits, their passes, and the change, in pixels, after which the moves are known.
_ROUNDS, _PASSES, _SETTLED = 5, 1.0, 0.02
# A step may be so many times what a fit says.
_FARTHEST = 3.0


@dataclass(frozen=True)
class _Left:
    """What a fit says is still to be moved.

    Attributes
    ----------
    whole : (moves,) array
        Moves of the whole scanner, those alone that are sure.
    views : (views, 2) array
        Shifts of single views, likewise.
    pixels : float
        The largest of them, as seen.
    clear : bool
        Whether any is large, and sure, enough to be looked for.
    """

    whole: np.ndarray
    views: np.ndarray
    pixels: float
    clear: bool


def realigned(problem: Problem, axis: Answer, means: Means, report: Callable[[float, str], Any]) -> Answer:
    """Where the scanner stood, as a fit of one pass tells it; a few more find it out where it says that it moved.

    Parameters
    ----------
    problem : Problem
        As told.
    axis : Answer
        Of `plan.axis.find_axis`, with which it begins.
    means : Means
    report : callable
        Gets the share done, none, and words.

    Returns
    -------
    Answer
        That of the axis, where there is no more to move, or where held-out rays do not confirm it.
    """
    report(0.0, "alignment")
    try:
        moved, misfits = _Realignment(problem, axis, means).moved(_tensors(axis.value))
    except Exception as error:
        # Processes that share the steps may be left behind by one that fails.
        if current_ranks().count > 1:
            raise
        logger.warning("A short fit failed, so the scanner stays where it is: %r", error)
        return axis
    moves = {name: value.tolist() for name, value in moved.items() if bool(value.any())}
    words, told = Alignment.told(moves), {"without": misfits[0], "moved": misfits[-1]}
    if moves == axis.value or not worth_it(misfits[0], misfits[-1]):
        logger.info(
            "Alignment: %s", f"not confirmed: {words}" if moves != axis.value else "no more has moved"
        )
        return axis
    logger.warning("The scanner stood elsewhere: %s. align=False leaves it.", words)
    return Answer(moves, words, Status.ASKED, {**axis.evidence, **told})


class _Realignment:
    """Fits of a pass or two, and what they say of the scanner."""

    def __init__(self, problem: Problem, axis: Answer, means: Means) -> None:
        self.problem, self.means = problem, means
        self.scanner = Scanner(problem.geometry, axis_of(problem))
        whole = ["u"] if problem.geometry.planar else list(_WHOLE)
        if axis.evidence.get("error", math.inf) <= _AXIS_KNOWN:
            whole.remove("u")
        found = effects(self.scanner, whole, 1.0)
        self.names = tuple(name for name, effect in found.items() if effect.told >= _TOLD)
        self.seen = np.array([found[name].pixels for name in self.names])
        self.gauge = view_gauge(self.scanner).numpy()
        self.settings = replace(coarse_settings(means.settings), passes=_PASSES)

    def moved(self, values: dict[str, torch.Tensor]) -> tuple[dict[str, torch.Tensor], list[float]]:
        """Where the scanner stood, and the misfits of held-out rays of fits by it, the first as it is."""
        misfits: list[float] = []
        before: tuple[np.ndarray, np.ndarray] | None = None
        for number in range(_ROUNDS):
            gaussians, scene, rays, misfit = self._fitted(values)
            misfits.append(misfit)
            if number == _ROUNDS - 1:
                break
            left = self._left(gaussians, scene, rays, values)
            if not (number or left.clear) or not left.pixels:
                break
            step = left.whole if before is None else _secant(left.whole, *before)
            before = left.whole, step
            values = self._stepped(values, step, left.views)
            if left.pixels < _SETTLED:
                break
        return values, misfits

    def _left(
        self, gaussians: Gaussians, scene: FitScene, rays: Rays, values: dict[str, torch.Tensor]
    ) -> _Left:
        """What a fit says is still to be moved."""
        falls = falls_of(self.scanner, values, (*self.names, "u", "v"))
        sums = move_sums(gaussians, scene, rays, self.settings, falls)
        normal, told, many = sums.normal, sums.told, len(self.names)
        moves = whole_moves(normal.sum(axis=0), told.sum(axis=0), range(many))
        size, error = np.abs(moves.value) * self.seen, moves.error * self.seen
        whole = np.where(size > _FOUND * error, moves.value, 0.0)
        told = told - normal[..., :many] @ whole
        single = slice(many, many + 3)
        shifts = shifts_of_views(normal[:, :, single, single], told[:, :, single], self.gauge)
        rms = np.sqrt(np.mean(shifts**2, axis=0))
        pixels = float(max((np.abs(whole) * self.seen).max(initial=0.0), rms.max()))
        clear = bool((size > _LEAST + _SURE * error).any() or (rms > _LEAST).any())
        logger.debug("left: %s of errors %s, views %s px", moves.value, moves.error, rms)
        return _Left(whole, shifts, pixels, clear)

    def _stepped(
        self, values: dict[str, torch.Tensor], whole: np.ndarray, shifts: np.ndarray
    ) -> dict[str, torch.Tensor]:
        """Values of the moves after a step; those that are 0 are left out."""
        values = dict(values)
        for name, by in [*zip(self.names, whole), ("views", shifts)]:
            if np.any(by):
                values[name] = values.get(name, 0.0) + torch.as_tensor(by, dtype=torch.float64)
        return values

    def _fitted(self, values: dict[str, torch.Tensor]) -> tuple[Gaussians, FitScene, Rays, float]:
        """A fit by the scanner as it stood, with the misfit of its held-out rays."""
        settings, device = self.settings, self.means.device
        problem = self.problem.seen_by(moved_geometry(self.scanner, values)) if values else self.problem
        start, _ = first_volume(problem, device, settings)
        plan = plan_from_start(start, problem, settings, device)
        scene, rays = scene_of(problem, plan, settings, device), rays_of(problem, plan, settings, device)
        seeds, _ = first_gaussians(start, plan, problem, settings, device)
        outcome = fitted_shortly(seeds, plan, problem, scene, rays, replace(self.means, settings=settings))
        errors = [entry["held_out"] or entry["loss"] for entry in outcome.history] or [math.inf]
        return outcome.gaussians, scene, rays, float(min(errors))


def _secant(left: np.ndarray, left_before: np.ndarray, step: np.ndarray) -> np.ndarray:
    """How far to go, of what was left before a step and after it: the object hides a part of a move from each fit."""
    gained = left_before - left
    with np.errstate(divide="ignore", invalid="ignore"):
        times = np.where((left_before != 0) & (gained * step > 0), step / gained, 1.0)
    return left * np.clip(times, 1.0, _FARTHEST)


def _tensors(moves: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    return {name: torch.tensor(value, dtype=torch.float64) for name, value in moves.items()}
