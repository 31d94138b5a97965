"""What a fit begins with: a caller's options, the physics, the plan, and the first Gaussians."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from tomo_polysplat.checks import fail, require_number
from tomo_polysplat.fit.agent import settings_for_agent
from tomo_polysplat.fit.calibrated_physics import describe_scatter, with_fitted
from tomo_polysplat.fit.calibration import Calibration, calibrated
from tomo_polysplat.fit.checkpoint import Checkpoint
from tomo_polysplat.fit.detail import choose_growth, smooth_less
from tomo_polysplat.fit.first_volume import first_volume
from tomo_polysplat.fit.plan import Plan, make_plan
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.sharpness import seeds_for_edges
from tomo_polysplat.fit.smoothing import choose_smoothing
from tomo_polysplat.fit.stopping import FitState
from tomo_polysplat.kernels.select import pick_fast_device
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings, make_settings

__all__ = ["PreparedFit", "RunOptions", "prepare", "calibrate", "physics", "under"]


@dataclass(frozen=True)
class RunOptions:
    """How a caller wants a scan fitted, checked.

    Attributes
    ----------
    settings : Settings
    time_budget : float or None
        Seconds.
    seed : int
    device : torch.device
    callbacks : list of callables
    """

    settings: Settings
    time_budget: float | None
    seed: int
    device: torch.device
    callbacks: list[Callable[[FitState], Any]]

    @classmethod
    def of(
        cls, quality: str, settings: Any, time_budget: Any, seed: Any, device: str, callbacks: Any
    ) -> RunOptions:
        """Those of `reconstruct`'s arguments."""
        chosen = make_settings(quality, settings)
        if time_budget is not None:
            time_budget = require_number("time_budget", time_budget, above=0)
        return cls(chosen, time_budget, _whole(seed), pick_fast_device(device), _functions(callbacks))

    def to_dict(self) -> dict[str, Any]:
        """All that the result depends on, for a checkpoint."""
        return self.settings.to_dict() | {"seed": self.seed, "time_budget": self.time_budget}


@dataclass(frozen=True)
class PreparedFit:
    """All that a fit starts from."""

    plan: Plan
    gaussians: Gaussians
    scene: FitScene
    rays: Rays


def physics(
    problem: Problem,
    wanted: Calibration | None,
    run_options: RunOptions,
    saved: Checkpoint | None,
    report: Callable[[float, str], Any],
) -> tuple[Problem, dict[str, Any]]:
    """The problem under the physics that short fits, or those before a checkpoint, have found, and its record."""
    if saved is not None and saved.plan is not None:
        return under(problem, saved.plan.reasons.get("calibration"))
    if wanted is None:
        return problem, {}
    report(0.0, "calibration")
    return under(problem, calibrate(problem, wanted, run_options))


def calibrate(problem: Problem, wanted: Calibration, run_options: RunOptions) -> dict[str, Any]:
    """The record of a calibration."""
    return calibrated(
        problem, wanted, run_options.settings, run_options.device, run_options.seed, run_options.time_budget
    )


def under(problem: Problem, found: dict[str, Any] | None) -> tuple[Problem, dict[str, Any]]:
    """The problem under what a calibration has found, and what the plan tells of it."""
    if found is None:
        return problem, {}
    reasons: dict[str, Any] = {"calibration": found}
    if "scatter" in found["accepted"]:
        modelled = found["accepted"]["scatter"]
        what = f"modelled: {describe_scatter(found['fitted'])}" if modelled else f"none: {found['why']}"
        reasons["scatter"] = what
    return with_fitted(problem, found["fitted"]), reasons


def prepare(
    problem: Problem, run_options: RunOptions, saved: Checkpoint | None, report: Callable[[float, str], Any]
) -> PreparedFit:
    """Plan, seed and set up, or go on from where a checkpoint was; ``report`` gets the share done, none, and words.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C: there is no result yet.
    """
    settings, device, options = run_options.settings, run_options.device, run_options.to_dict()
    try:
        if saved is not None and saved.snapshot is not None and saved.plan is not None:
            plan, gaussians = saved.plan, saved.snapshot.gaussians.to(device)
            return PreparedFit(plan, gaussians, *_model(problem, plan, run_options))
        report(0.0, "start volume")
        start, why = first_volume(problem, device, settings)
        plan = make_plan(start, problem, settings, device.type)
        scene, rays = _model(problem, plan, run_options)
        report(0.0, "seeds")
        settings, agent = settings_for_agent(start, plan.first, problem, settings, device, options)
        plan.reasons |= {"start": why, **agent}
        plan, gaussians, tried = seeds_for_edges(start, plan, problem, scene, rays, settings, device, options)
        choose_growth(gaussians, tried, plan, scene, rays, settings)
        choose_smoothing(gaussians, plan, problem, scene, rays, settings, options)
        smooth_less(plan, settings)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("interrupted before the fit had begun: there is no result yet") from None
    if saved is not None:
        saved.plan = plan
    return PreparedFit(plan, gaussians, scene, rays)


def _model(problem: Problem, plan: Plan, run_options: RunOptions) -> tuple[FitScene, Rays]:
    """The forward model and what it is compared with."""
    settings, device = run_options.settings, run_options.device
    return problem.scene(plan, settings, device), problem.rays(plan, settings, device)


def _whole(seed: Any) -> int:
    number = require_number("seed", seed, at_least=0)
    if number != int(number):
        raise fail("seed", "a whole number", repr(seed))
    return int(number)


def _functions(callbacks: Any) -> list[Callable[[FitState], Any]]:
    functions = [callbacks] if callable(callbacks) else list(callbacks)
    for function in functions:
        if not callable(function):
            raise fail("callbacks", "functions of a FitState", repr(function), error=TypeError)
    return functions
