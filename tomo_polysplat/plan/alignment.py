"""Where the scanner stood, told by short fits that move its geometry, before the run.

`nuisances.alignment_search` has the order of the search. Here are its fits: Gaussians of a coarse volume, seeded and
fitted anew at every level while the geometry moves, and one at the detector's own resolution for the last hundredths
of a pixel.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from tomo_polysplat.checks import fail, require_choice
from tomo_polysplat.fit.fitter import next_views
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.fit.step import EagerStep
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.nuisances.alignment import Alignment
from tomo_polysplat.nuisances.alignment_search import levels, schedule, search
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.axis import is_known
from tomo_polysplat.plan.coarse import coarse_problem, coarse_settings, joined_pixels
from tomo_polysplat.plan.first_gaussians import first_gaussians
from tomo_polysplat.plan.first_volume import first_volume
from tomo_polysplat.plan.fit_options import FitOptions
from tomo_polysplat.plan.model import rays_of, scene_of
from tomo_polysplat.plan.order import plan_from_start
from tomo_polysplat.scan.as_told import seen_as_told
from tomo_polysplat.scan.moves import MOVES

__all__ = ["align", "moves_of"]

logger = logging.getLogger(__name__)

# Passes of the fit of a level, and views of its steps.
_PASSES, _VIEWS = 6, 6


def moves_of(wanted: Any, time_budget: float | None) -> str | list[str] | None:
    """The argument ``align`` of `reconstruct`: "auto", "usual" or names of moves; None where all stays as told.

    Raises
    ------
    ValueError, TypeError
        For anything but a bool, "auto" and names of moves, and for fits beside a time budget, which they would not
        keep.
    """
    if wanted is None or wanted is False:
        return None
    names = [wanted] if isinstance(wanted, str) else wanted
    if isinstance(names, Sequence) and list(names) == ["auto"]:
        return "auto"
    if time_budget is not None:
        raise fail(
            "align", "'auto' or none beside a time_budget, which its fits would not keep", repr(wanted)
        )
    if wanted is True:
        return "usual"
    if not isinstance(names, Sequence):
        raise fail("align", "True, False, 'auto' or names of moves", repr(wanted), error=TypeError)
    for name in names:
        if name == "auto":
            raise fail("align", "'auto' alone", repr(wanted), "name the moves that are to be found")
        require_choice("align", name, tuple(MOVES))
    return list(names)


def align(
    problem: Problem,
    names: str | Sequence[str],
    options: FitOptions,
    axis: Answer | None,
    report: Callable[[float, str], Any],
) -> Answer:
    """What of the scanner's geometry has moved, as the rays tell it.

    Parameters
    ----------
    problem : Problem
        As told.
    names : "usual" or names of moves
        See `nuisances.alignment.Alignment`.
    options : FitOptions
    axis : Answer or None
        Of `find_axis`, where that was asked: a move to begin with.
    report : callable
        Gets the share done, none, and words.

    Returns
    -------
    Answer
        Its value is a dict of moves by name, empty where none was confirmed, as `aligned` takes it.
    """
    start = {} if axis is None else axis.value
    alignment = Alignment(problem.geometry, 1.0, names=names, pivot=problem.axis, start=start)
    trials = _Levels(problem, alignment, options, report)
    factors = levels(problem.geometry.columns)
    # Where the axis is known, the coarsest detector has nothing to find that the next does not.
    skipped = int(axis is not None and is_known(axis) and len(factors) > 1)
    factors = factors[skipped:]
    record = search(alignment, lambda level, *asked: trials.fit(skipped + level, *asked), factors)
    confirmed = tuple(record["confirmed"])
    if confirmed and factors[-1] > 1:
        alignment.forget()
        trials.fit(skipped + len(factors), 1, confirmed)
    moves = {name: value.tolist() for name, value in alignment.values.items() if bool(value.any())}
    last = record["levels"][-1]
    evidence = {name: float(value) for name, value in last.items() if isinstance(value, float)}
    if axis is not None:
        evidence |= {
            name: axis.evidence[name] for name in ("offset", "error", "turned") if name in axis.evidence
        }
    words = alignment.describe() if moves else "the rays confirm no move"
    logger.info("Alignment: %s", words)
    return Answer(moves, words, Status.ASKED, evidence)


@dataclass(frozen=True)
class _Levels:
    """The fits that `search` asks for."""

    problem: Problem
    alignment: Alignment
    options: FitOptions
    report: Callable[[float, str], Any]

    def fit(self, level: int, factor: int, names: tuple[str, ...]) -> float:
        """Fit Gaussians anew to pixels of which ``factor`` are joined while these moves go on; see `search`."""
        self.report(0.0, f"alignment, {factor} pixels joined" if factor > 1 else "alignment")
        problem, rows = coarse_problem(self.problem, factor)
        setup = self._seeded(problem, factor)
        held = tuple(name for name in self.alignment.names if name not in names)
        step = _AligningStep(setup)
        step.alignment, step.joined = self.alignment, (factor, rows)
        rng, views = np.random.default_rng(self.options.seed), len(setup.rays.views)
        batch = min(_VIEWS, views)
        steps_of_a_pass = max(1, round(views / batch))
        steps, pace, errors = _PASSES * steps_of_a_pass, schedule(level, factor), []
        order = np.empty(0, int)
        for number in range(steps):
            chosen, order = next_views(order, batch, views, rng)
            step(chosen, number / steps)
            if names:
                step.move(chosen, pace.rate(number / steps, factor), held)
            if (number + 1) % steps_of_a_pass == 0:
                with torch.no_grad():
                    setup.scene.keep_within(setup.gaussians)
                self.alignment.hold_gauge(held)
                fitted, held_out, _ = step.read()
                errors.append(fitted if math.isnan(held_out) else held_out)
        return float(np.mean(errors[-2:]))

    def _seeded(self, problem: Problem, factor: int) -> FitSetup:
        """Seeds of the start volume that the told geometry gives of projections as it would have seen them."""
        told = problem
        if any(bool(value.any()) for value in self.alignment.values.values()):
            whole = torch.from_numpy(np.asarray(self.problem.projections))
            seen = seen_as_told(whole, self.alignment.scanner, self.alignment.values).numpy()
            rows = min(factor, self.problem.geometry.rows)
            told = replace(problem, projections=joined_pixels(seen, rows, factor))
        settings = coarse_settings(self.options.settings)
        start, _ = first_volume(told, self.options.device, settings)
        plan = plan_from_start(start, told, settings, self.options.device)
        gaussians, _ = first_gaussians(start, plan, told, settings, self.options.device)
        scene = scene_of(problem, plan, settings, self.options.device)
        rays = rays_of(problem, plan, settings, self.options.device)
        return FitSetup(gaussians, plan.spacing * problem.voxel, rays, scene, plan.adapted(settings))


class _AligningStep(EagerStep):
    """A step that keeps the gradient by the views' vectors, along which `move` then goes."""

    alignment: Alignment
    joined: tuple[int, int]

    def _predict(self, views: np.ndarray, chosen: DetectorViews) -> tuple[torch.Tensor, int]:
        self._vectors = self.alignment.vectors(views, *self.joined).requires_grad_()
        return self.scene.projections(self.gaussians, chosen, self._vectors)

    def move(self, views: np.ndarray, rate: float, held: Sequence[str]) -> None:
        """Move the scanner by about so many pixels against the gradient of the last step."""
        assert self._vectors.grad is not None
        gradient = self.alignment.gradient(views, self._vectors.grad, *self.joined)
        self.alignment.step(views, gradient, rate, held)
