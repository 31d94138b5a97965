"""How strongly a slice is smoothed, told by rays that are held out of two short fits.

A slice of few rays a voxel can fit noise and the streaks of missing views as well as the object: what fits the others
best need not fit the rays that are held out. How much smoothing that takes depends on noise, views and detail together;
photon noise alone does not tell a brain, which gains by it, from a laminate, which loses.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from tomo_polysplat.fit.plan import Plan
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.short_fit import cut_short, fitted_shortly
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings
from tomo_polysplat.start.initial import FEW_VIEWS

__all__ = ["slice_smoothing"]

logger = logging.getLogger(__name__)

# So many times the usual weight is tried, and taken where it leaves less of the held-out misfit. Eight slices that gain
# 0.4 to 3.9 dB by it came to 0.79 to 0.92, one that loses 0.6 to 0.88, a laminate that loses 2.4 to 1.09
# (docs/limits.md).
_TIMES = 3.0
# Of a short fit: the longer it is, the less it shows of what smoothing holds back.
_PASSES = 3.0
# With more rays a voxel short fits are too early to tell: slices of 3.9, which lose 1.3 dB, would have it.
_MOST_RAYS = 3.0
# A run of fewer passes, as of the fast preset, is in a hurry; fewer rays held out tell their own noise.
_FEWEST_PASSES, _FEWEST_HELD_OUT = 10.0, 100


def slice_smoothing(
    seeds: Gaussians,
    plan: Plan,
    problem: Problem,
    scene: FitScene,
    rays: Rays,
    settings: Settings,
    options: Mapping[str, Any],
) -> None:
    """Set the plan's ``tv_factor`` and say why.

    Parameters
    ----------
    seeds : Gaussians
        Of the fit to come; left as they are.
    plan : Plan
        Changed in place.
    problem : Problem
    scene, rays : FitScene, Rays
        The problem's.
    settings : Settings
        Of the fit to come.
    options : mapping
        ``seed`` and ``time_budget`` of the reconstruction.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C.
    """
    if settings.tv_factor:
        plan.tv_factor = settings.tv_factor
        plan.reasons["smoothing"] = f"{plan.tv_factor:g} times the usual weight: asked for"
        return
    why_not = _why_not(len(seeds), plan, problem, settings)
    if why_not:
        plan.reasons["smoothing"] = f"the usual weight: {why_not}"
        return
    left = []
    for factor in (1.0, _TIMES):
        short = replace(plan.adapted(settings), passes=_PASSES, soft_gain=0.0)
        short = replace(short, tv_weight=factor * short.tv_weight)
        outcome = fitted_shortly(
            seeds.copy(), plan, problem, scene, rays, short, options["seed"], options["time_budget"]
        )
        if cut_short(outcome):
            plan.reasons["smoothing"] = "the usual weight: the time budget is too short to tell"
            return
        left.append(outcome.history[-1]["held_out"])
    share = left[1] / left[0] if left[0] else 1.0
    plan.tv_factor = _TIMES if share < 1.0 else 1.0
    weight = f"{_TIMES:g} times the usual weight" if plan.tv_factor > 1 else "the usual weight"
    plan.reasons["smoothing"] = (
        f"{weight}: after a short fit {_TIMES:g} times as much leaves {share:.2f} of the misfit of the held-out rays"
    )
    logger.info("A slice is smoothed with %s", plan.reasons["smoothing"])


def _why_not(seeds: int, plan: Plan, problem: Problem, settings: Settings) -> str:
    """Why no short fits are made, if so."""
    views, rays = problem.geometry.views, problem.geometry.views * problem.geometry.columns
    if not problem.planar:
        return "asked of slices only"
    if not (seeds and settings.tv_weight):
        return "there is nothing to smooth"
    if plan.passes < _FEWEST_PASSES:
        return "in so few passes two short fits would take too long a part"
    if views < FEW_VIEWS:
        return f"fewer than {FEW_VIEWS} views do not tell"
    if settings.held_out * rays < _FEWEST_HELD_OUT:
        return f"fewer than {_FEWEST_HELD_OUT} rays are held out"
    if rays > _MOST_RAYS * math.prod(problem.grid.shape):
        return f"more than {_MOST_RAYS:g} rays a voxel need no more"
    return ""
