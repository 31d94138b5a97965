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
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.step import EagerStep
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.nuisances.alignment import Alignment
from tomo_polysplat.nuisances.alignment_search import levels, schedule, search
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.first_gaussians import first_gaussians
from tomo_polysplat.plan.first_volume import first_volume
from tomo_polysplat.plan.model import rays_of, scene_of
from tomo_polysplat.plan.order import plan_from_start
from tomo_polysplat.scan.as_told import seen_as_told
from tomo_polysplat.scan.geometry import VolumeGrid
from tomo_polysplat.scan.moves import MOVES, Scanner, moved_geometry
from tomo_polysplat.settings import Settings

__all__ = ["align", "aligned", "moves_of"]

logger = logging.getLogger(__name__)

# Passes of the fit of a level, views of its steps, the share of rays that is held out of it, and voxels of the coarsest
# volume along its longest edge.
_PASSES, _VIEWS, _HELD_OUT, _FEWEST_VOXELS = 6, 6, 0.1, 8
# What the fit of a level does without: it shows where edges lie, not how fine they are.
_PLAIN: dict[str, Any] = {"pixel_rays": 1, "growth": 1.0, "edges": "blurred", "soft_gain": 0.0}


def moves_of(wanted: Any, time_budget: float | None) -> str | list[str] | None:
    """The argument ``align`` of `reconstruct` as `align` takes it; None for a geometry that stays as told.

    Raises
    ------
    ValueError, TypeError
        For anything but a bool, "auto" and names of moves, and beside a time budget, which it would not keep.
    """
    if wanted is None or wanted is False:
        return None
    if time_budget is not None:
        raise fail("align", "none beside a time_budget, which its fits would not keep", repr(wanted))
    names = [wanted] if isinstance(wanted, str) else wanted
    if wanted is True or names == ["auto"]:
        return "auto"
    if not isinstance(names, Sequence):
        raise fail("align", "True, False, 'auto' or names of moves", repr(wanted), error=TypeError)
    for name in names:
        require_choice("align", name, tuple(MOVES))
    return list(names)


def align(
    problem: Problem,
    names: str | Sequence[str],
    settings: Settings,
    device: torch.device,
    seed: int,
    report: Callable[[float, str], Any],
) -> Answer:
    """What of the scanner's geometry has moved, as the rays tell it.

    Parameters
    ----------
    problem : Problem
        As told.
    names : "auto" or names of moves
        See `nuisances.alignment.Alignment`.
    settings : Settings
    device : torch.device
    seed : int
    report : callable
        Gets the share done, none, and words.

    Returns
    -------
    Answer
        Its value is a dict of moves by name, empty where none was confirmed, as `aligned` takes it.
    """
    alignment = Alignment(problem.geometry, 1.0, names=names, pivot=_axis(problem))
    trials = _Levels(problem, alignment, settings, device, seed, report)
    factors = levels(problem.geometry.columns)
    record = search(alignment, trials.fit, factors)
    confirmed = tuple(record["confirmed"])
    if confirmed and factors[-1] > 1:
        alignment.forget()
        trials.fit(len(factors), 1, confirmed)
    moves = {name: value.tolist() for name, value in alignment.values.items() if bool(value.any())}
    last = record["levels"][-1]
    evidence = {name: float(value) for name, value in last.items() if isinstance(value, float)}
    words = alignment.describe() if moves else "the rays confirm no move"
    logger.info("Alignment: %s", words)
    return Answer(moves, words, Status.ASKED, evidence)


def aligned(problem: Problem, moves: dict[str, Any]) -> Problem:
    """The problem by the scanner as it stood."""
    if not moves:
        return problem
    values = {name: torch.tensor(value, dtype=torch.float64) for name, value in moves.items()}
    return problem.seen_by(moved_geometry(Scanner(problem.geometry, _axis(problem)), values))


def _axis(problem: Problem) -> np.ndarray:
    """A point on the axis of rotation, in the solver's coordinates."""
    return -problem.centre / problem.length


@dataclass(frozen=True)
class _Levels:
    """The fits that `search` asks for."""

    problem: Problem
    alignment: Alignment
    settings: Settings
    device: torch.device
    seed: int
    report: Callable[[float, str], Any]

    def fit(self, level: int, factor: int, names: tuple[str, ...]) -> float:
        """Fit Gaussians anew to pixels of which ``factor`` are joined while these moves go on; see `search`."""
        self.report(0.0, f"alignment, {factor} pixels joined" if factor > 1 else "alignment")
        problem, rows = self._coarse(factor)
        gaussians, spacing, scene, rays, settings = self._seeded(problem, factor)
        held = tuple(name for name in self.alignment.names if name not in names)
        step = _AligningStep(gaussians, spacing, rays, scene, settings)
        step.alignment, step.joined = self.alignment, (factor, rows)
        rng, views = np.random.default_rng(self.seed), len(rays.views)
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
                    scene.keep_within(gaussians)
                self.alignment.hold_gauge(held)
                fitted, held_out, _ = step.read()
                errors.append(fitted if math.isnan(held_out) else held_out)
        return float(np.mean(errors[-2:]))

    def _coarse(self, factor: int) -> tuple[Problem, int]:
        """The problem by joined pixels and voxels, and how many rows are joined."""
        problem = self.problem
        geometry = problem.geometry.binned(factor)
        rows = 1 if problem.geometry.rows == 1 else factor
        voxels = [n if n == 1 else max(_FEWEST_VOXELS, n // factor) for n in problem.grid.shape]
        grid = VolumeGrid((voxels[0], voxels[1], voxels[2]), problem.grid.lower, problem.grid.upper)
        values = _joined(problem.projections, rows, factor)
        behind = None if problem.filter_map is None else problem.filter_map.joined(rows, factor)
        whole = replace(problem, projections=values, geometry=geometry, grid=grid, margin=(0, 0))
        return replace(whole, filter_map=behind), rows

    def _seeded(self, problem: Problem, factor: int) -> tuple[Gaussians, float, FitScene, Rays, Settings]:
        """Seeds of the start volume that the told geometry gives of projections as it would have seen them."""
        told = problem
        if any(bool(value.any()) for value in self.alignment.values.values()):
            whole = torch.from_numpy(self.problem.projections)
            seen = seen_as_told(whole, self.alignment.scanner, self.alignment.values).numpy()
            rows = 1 if self.problem.geometry.rows == 1 else factor
            told = replace(problem, projections=_joined(seen, rows, factor))
        settings = replace(self.settings, **_PLAIN, held_out=max(_HELD_OUT, self.settings.held_out))
        start, _ = first_volume(told, self.device, settings)
        plan = plan_from_start(start, told, settings, self.device)
        gaussians, _ = first_gaussians(start, plan, told, settings, self.device)
        scene = scene_of(problem, plan, settings, self.device)
        rays = rays_of(problem, plan, settings, self.device)
        return gaussians, plan.spacing * problem.voxel, scene, rays, plan.adapted(settings)


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


def _joined(values: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Means of so many rows and columns together, of those that are no NaN; the rest at the far ends is dropped."""
    if rows == columns == 1:
        return values
    views, height, width = len(values), values.shape[1] // rows, values.shape[2] // columns
    parts = values[:, : height * rows, : width * columns].reshape(views, height, rows, width, columns)
    good = np.isfinite(parts)
    sums = np.where(good, parts, 0).sum(axis=(2, 4), dtype=np.float64)
    counts = good.sum(axis=(2, 4))
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan).astype(np.float32)
