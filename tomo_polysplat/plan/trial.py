"""How every short fit is made: seeds are fitted for a few passes, or for a share of the time there is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tomo_polysplat.fit.optimise import Course, FitOutcome, fit
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.fit.stopping import StopReason
from tomo_polysplat.kernels.compile_time import working_time
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.plan.fit_options import FitOptions
from tomo_polysplat.plan.plan import Plan

__all__ = ["TOO_SHORT", "fitted_shortly", "views_of_short_steps"]

# Why a short fit that the time budget ended tells nothing.
TOO_SHORT = "the time budget is too short to tell"
# Of the seconds that a reconstruction may take, the share for each short fit.
_SHARE_OF_BUDGET = 0.1


def views_of_short_steps(plan: Plan, problem: Problem) -> int:
    """Views of a step where passes are few: fewer than in the run, but in slices, whose steps are few as it is."""
    return plan.views_per_step if problem.planar else -(-2 * plan.views_per_step // 3)


def fitted_shortly(
    seeds: Gaussians,
    plan: Plan,
    problem: Problem,
    scene: FitScene,
    rays: Rays,
    options: FitOptions,
) -> FitOutcome:
    """Seeds fitted for the settings' passes, or for a share of the seconds of the whole reconstruction.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C: what was fitted so far is no result.
    """
    started = working_time()
    outcome = fit(
        FitSetup(seeds, plan.spacing * problem.voxel, rays, scene, replace(options.settings, growth=1.0)),
        Course(
            views_per_step=views_of_short_steps(plan, problem),
            rng=np.random.default_rng(options.seed),
            started=started,
            deadline=None
            if options.time_budget is None
            else started + _SHARE_OF_BUDGET * options.time_budget,
            volume=lambda gaussians: scene.volume(gaussians).cpu().numpy(),
        ),
    )
    if outcome.stop is not None and outcome.stop.reason is StopReason.INTERRUPTED:
        raise KeyboardInterrupt("interrupted during a short fit: there is no result yet")
    return outcome
