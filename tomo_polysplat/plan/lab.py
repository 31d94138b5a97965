"""What a question may use: the scan, its start volume, and short fits."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch

from tomo_polysplat.fit.fitter import Fitter
from tomo_polysplat.fit.optimise import FitOutcome, Run
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.kernels.compile_time import working_time
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.plan.first_gaussians import first_gaussians
from tomo_polysplat.plan.fit_options import FitOptions
from tomo_polysplat.plan.model import rays_of, scene_of
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.plan.trial import TOO_SHORT, fitted_shortly
from tomo_polysplat.plan.unit_check import doubt_lengths
from tomo_polysplat.settings import Settings

__all__ = ["Lab", "Untold"]


class Untold(Exception):
    """A question that the data could not answer, and why."""


@dataclass(eq=False)
class Lab:
    """One scan, ready to be asked.

    Attributes
    ----------
    problem : Problem
    start : (nz, ny, nx) tensor or None
        First reconstruction in the solver's units (`plan.first_volume`); None during a run.
    settings : Settings
        The caller's.
    device : torch.device
    seed : int
    time_budget : float or None
        Seconds of the whole reconstruction.
    plan : Plan
        What has been decided so far.
    short_fit : callable or None
        Fits the start under other settings, for a number of steps (`plan.short_fit.short_fit`).
    calibrate : callable or None
        Makes the short fits that tell scatter, and returns their record.
    gaussians : Gaussians or None
        That the run begins with, or goes on with from a checkpoint.
    run : Run or None
        The run, between two of its passes.
    end : float or None
        When the time budget ends, in seconds of ``kernels.compile_time.working_time``.
    """

    problem: Problem
    start: Any
    settings: Settings
    device: torch.device
    seed: int = 0
    time_budget: float | None = None
    plan: Plan = field(default_factory=Plan)
    short_fit: Callable[..., Any] | None = None
    calibrate: Callable[[], dict[str, Any]] | None = None
    gaussians: Gaussians | None = None
    run: Run | None = None
    end: float | None = None
    _seeds: dict[Any, tuple[Gaussians, dict[str, Any]]] = field(default_factory=dict, init=False)
    _trials: dict[Any, FitOutcome] = field(default_factory=dict, init=False)

    @cached_property
    def relative(self) -> torch.Tensor:
        """(nz, ny, nx) the start in soft references."""
        return torch.as_tensor(self.start) / (self.plan.reference * self.problem.depth)

    @cached_property
    def support(self) -> int:
        """Voxels of the start that are not empty."""
        return int((self.start > self.least).sum())

    @property
    def least(self) -> float:
        """What the start holds less of is empty, in its own units."""
        return self.plan.support_level * self.plan.reference * self.problem.depth

    @cached_property
    def scene(self) -> FitScene:
        """The forward model under what was decided from the start."""
        return scene_of(self.problem, self.plan, self.settings, self.device)

    @cached_property
    def rays(self) -> Rays:
        """The measured rays."""
        return rays_of(self.problem, self.plan, self.settings, self.device)

    @property
    def late(self) -> bool:
        """Whether the time budget is over."""
        return self.end is not None and working_time() >= self.end

    @property
    def seeding(self) -> Settings:
        """The settings of the fit to come, with what the search for an agent has changed."""
        return self.plan.with_agent(self.settings)

    def fit_options(self, settings: Settings) -> FitOptions:
        """What a short fit under these settings may use."""
        return FitOptions(settings, self.time_budget, self.seed, self.device)

    def branch(self, **changes: Any) -> Fitter:
        """Another way for the run to go on, with changes to its scene by name.

        Raises
        ------
        Untold
            Where there is no room for a second cloud.
        """
        assert self.run is not None
        try:
            return self.run.fitter.branch(**changes)
        except RuntimeError as full:  # torch's, of a GPU
            raise Untold(f"{full}") from full

    def seeds(self, **assumed: Any) -> Gaussians:
        """Seeds of the plan, or of one with other values of some answers; made once, to be copied before a fit."""
        return self._seeded(self.plan.assuming(**assumed))[0]

    def facts_of_seeds(self) -> Mapping[str, Any]:
        """What was counted when the seeds of the plan were made."""
        return self._seeded(self.plan)[1]

    def _seeded(self, plan: Plan) -> tuple[Gaussians, dict[str, Any]]:
        key = (plan.spacing, plan.sharp, self.seeding)
        if key not in self._seeds:
            # Made anew where it is asked for again: seeding takes the room.
            self.__dict__.pop("relative", None)
            self._seeds[key] = first_gaussians(self.start, plan, self.problem, self.seeding, self.device)
        return self._seeds[key]

    def trial(self, settings: Settings, rays: Rays | None = None, **assumed: Any) -> FitOutcome:
        """A short fit of the seeds of the plan, or of one with other values of some answers; made once.

        Raises
        ------
        Untold
            If the time budget ended it.
        """
        plan, rays = self.plan.assuming(**assumed), rays or self.rays
        key = (settings, rays.held_out, plan.spacing, plan.sharp, self.seeding)
        if key not in self._trials:
            seeds = self._seeded(plan)[0].copy()
            parts = (seeds, plan, self.problem, self.scene, rays)
            self._trials[key] = fitted_shortly(*parts, self.fit_options(settings))
        outcome = self._trials[key]
        if outcome.stop is not None and outcome.stop.by_time:
            raise Untold(TOO_SHORT)
        return outcome

    def doubt_lengths(self, words: str) -> None:
        """Say that the unit of length looks wrong."""
        doubt_lengths(self.plan.facts, words)
