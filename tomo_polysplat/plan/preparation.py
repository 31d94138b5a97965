"""What a fit begins with: a caller's options, the physics, the plan, and the first Gaussians."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch

from tomo_polysplat.checks import fail, require_number
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.stopping import FitState
from tomo_polysplat.kernels.compile_time import track_compiling
from tomo_polysplat.kernels.select import pick_fast_device
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.calibrated_physics import describe_scatter, with_fitted
from tomo_polysplat.plan.calibration import Calibration, calibrated
from tomo_polysplat.plan.checkpoint import Checkpoint
from tomo_polysplat.plan.decision import When
from tomo_polysplat.plan.first_volume import first_volume
from tomo_polysplat.plan.fit_options import FitOptions
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.model import rays_of, scene_of
from tomo_polysplat.plan.no_object import doubt_object
from tomo_polysplat.plan.order import alternatives, decide, decide_start
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.plan.seeds_in_time import seed_for_time
from tomo_polysplat.plan.short_fit import ShortFit, short_fit
from tomo_polysplat.scan.noise import RayNoise
from tomo_polysplat.settings import Settings, make_settings

__all__ = [
    "PreparedFit",
    "RunOptions",
    "calibrate",
    "fit_start",
    "lab_of",
    "no_result_yet",
    "physics",
    "prepare",
    "under",
]

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunOptions(FitOptions):
    """How a caller wants a scan fitted, checked.

    Attributes
    ----------
    callbacks : list of callables
    """

    callbacks: list[Callable[[FitState], Any]]

    @classmethod
    def of(
        cls, quality: str, settings: Any, time_budget: Any, seed: Any, device: str, callbacks: Any
    ) -> RunOptions:
        """Those of `reconstruct`'s arguments."""
        chosen = make_settings(quality, settings)
        if time_budget is not None:
            time_budget = require_number("time_budget", time_budget, above=0)
        track_compiling()
        return cls(chosen, time_budget, _whole(seed), pick_fast_device(device), _functions(callbacks))

    def allowing(self, noise: RayNoise) -> RunOptions:
        """The same where the model may miss every ray by what noise that does not grow with depth misses it by."""
        if not noise.deviation:
            return self
        allowed = math.hypot(self.settings.model_error, noise.deviation)
        return replace(self, settings=replace(self.settings, model_error=allowed))

    def to_dict(self) -> dict[str, Any]:
        """All that the result depends on, for a checkpoint."""
        return self.settings.to_dict() | {"seed": self.seed, "time_budget": self.time_budget}


@dataclass(frozen=True)
class PreparedFit:
    """All that a fit starts from; under a time budget with the start volume on the host, to be fallen back to."""

    plan: Plan
    gaussians: Gaussians
    scene: FitScene
    rays: Rays
    start: torch.Tensor | None = None


def physics(
    problem: Problem,
    wanted: Calibration | None,
    run_options: RunOptions,
    saved: Checkpoint | None,
    report: Callable[[float, str], Any],
) -> tuple[Problem, Plan]:
    """The problem under the physics that short fits, or those of a checkpoint, have found, and a plan that says so."""
    if saved is not None and saved.plan is not None:
        found = saved.plan.facts.get("calibration")
        return under(problem, None if found is None else found.value)
    if wanted is None:
        return problem, Plan()
    report(0.0, "calibration")
    return under(problem, calibrate(problem, wanted, run_options))


def calibrate(problem: Problem, wanted: Calibration, run_options: RunOptions) -> dict[str, Any]:
    """The record of a calibration."""
    return calibrated(
        problem, wanted, run_options.settings, run_options.device, run_options.seed, run_options.time_budget
    )


def under(problem: Problem, found: dict[str, Any] | None) -> tuple[Problem, Plan]:
    """The problem under what a calibration has found, and a plan that tells of it."""
    plan = Plan()
    if found is None:
        return problem, plan
    plan.note("calibration", found, str(found.get("why", "")))
    if "scatter" in found["accepted"]:
        modelled = bool(found["accepted"]["scatter"])
        why = f"modelled: {describe_scatter(found['fitted'])}" if modelled else f"none: {found['why']}"
        plan.answers["scatter"] = Answer(found["fitted"] if modelled else {}, why, Status.ASKED)
    return with_fitted(problem, found["fitted"]), plan


# What is to be fitted, how, what is known of it already, and by when.
def prepare(
    problem: Problem,
    plan: Plan,
    run_options: RunOptions,
    saved: Checkpoint | None,
    report: Callable[[float, str], Any],
    lab: Lab | None = None,
    end: float | None = None,
) -> PreparedFit:
    """Decide, seed and set up, or go on from where a checkpoint was.

    Parameters
    ----------
    problem : Problem
    plan : Plan
        What is known of the physics; that of a checkpoint tells it already.
    run_options : RunOptions
    saved : Checkpoint or None
    report : callable
        Gets the share done, none, and words.
    lab : Lab or None
        Of this problem, where a look at it has made one.
    end : float or None
        When a time budget ends, in seconds of ``kernels.compile_time.working_time``.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C: there is no result yet.
    """
    settings, device = run_options.settings, run_options.device
    with no_result_yet():
        if saved is not None and saved.snapshot is not None and saved.plan is not None:
            plan, gaussians = saved.plan, saved.snapshot.gaussians.to(device)
            scene = scene_of(problem, plan, settings, device)
            return PreparedFit(plan, gaussians, scene, rays_of(problem, plan, settings, device))
        if lab is None:
            report(0.0, "start volume")
            lab = lab_of(problem, plan, run_options, end)
            if lab.late:
                _warn_of_late_start(run_options.time_budget)
        else:
            lab.plan.facts = plan.facts | lab.plan.facts
            plan = lab.plan
        # Once: short fits about the scanner make many more.
        logger.info("A first volume by %s.", plan.facts["start"].value)
        report(0.0, "seeds")
        if end is not None:
            seed_for_time(lab, end)
        scene, rays = lab.scene, lab.rays
        doubt_object(problem, plan, rays.photons)
        decide(lab, When.TRIAL)
        gaussians, facts = lab.seeds(), lab.facts_of_seeds()
    _tell(plan, problem, facts)
    plan.note("alternatives", alternatives(lab))
    if saved is not None:
        saved.plan = plan
    kept = None if run_options.time_budget is None else lab.start.cpu()
    return PreparedFit(plan, gaussians, scene, rays, kept)


@contextmanager
def no_result_yet() -> Iterator[None]:
    """Say so after Ctrl-C."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt("interrupted before the fit had begun: there is no result yet") from None


def lab_of(problem: Problem, plan: Plan, options: FitOptions, end: float | None = None) -> Lab:
    """A lab for all questions of a problem, with what its start volume answers in the ``plan``."""
    settings, device = options.settings, options.device
    start, why = first_volume(problem, device, settings)
    lab = Lab(problem, start, settings, device, options.seed, options.time_budget, plan, fit_start, end=end)
    decide_start(lab)
    plan.note("start", why)
    return lab


def _warn_of_late_start(budget: float | None) -> None:
    remedy = "Give it more time, fewer voxels, or a GPU"
    logger.warning(
        "The start volume took all of the %g s of time_budget: little will be fitted. %s.", budget, remedy
    )


def fit_start(lab: Lab, settings: Settings, steps: int) -> ShortFit:
    """A short fit of the start of a ``lab`` under other settings."""
    assert lab.start is not None
    return short_fit(lab.problem, lab.start, {}, lab.fit_options(settings), fewest_steps=steps)


def _tell(plan: Plan, problem: Problem, facts: Mapping[str, tuple[Any, str]]) -> None:
    """Note what is no choice: the kind of model, and what the seeds came to."""
    known = (
        ("polychromatic", "a spectrum was given")
        if problem.polychromatic
        else ("monochromatic", "no spectrum was given, or one of a single energy")
    )
    plan.note("model", *known)
    flat, solid = "one row and one slice in one plane", "several rows or slices, or rays that leave the plane"
    plan.note("dimensions", problem.dimensions, flat if problem.planar else solid)
    for name, (value, why) in facts.items():
        plan.note(name, value, why)


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
