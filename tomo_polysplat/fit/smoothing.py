"""How strongly a volume is smoothed.

The misfit is counted in -log(I/I0) and the total variation in soft references, so what one weighs against the other
depends on how much light the object takes away: through a sample of a few millimetres a ray loses a tenth of it, and
what is a small residual there is a large share of the object. The usual weight, chosen on objects that take away half,
would melt a scaffold together.

How much smoothing is right depends on noise, views and detail together, and photon noise alone does not tell a brain,
which gains by more, from a laminate, which loses. So rays that are held out of short fits are asked: of thin objects,
which may be all smooth, whether the usual weight does as well, and of slices of few rays a voxel, which can fit noise
and the streaks of missing views as well as the object, whether more is better.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch

from tomo_polysplat.fit.depth import weights_by_depth
from tomo_polysplat.fit.loss import misfit
from tomo_polysplat.fit.plan import Plan
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import Rays, batches_around
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.short_fit import TOO_SHORT, Untold, cut_short, fitted_shortly, views_of_short_steps
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings
from tomo_polysplat.start.initial import FEW_VIEWS

__all__ = ["choose_smoothing"]

logger = logging.getLogger(__name__)

# In thin objects less than the usual weight is taken where it leaves less than this of the held-out misfit.
_CLEARLY = 0.97
# In slices so many times the usual weight is tried, and taken where it leaves less of the held-out misfit. Eight slices
# that gain 0.4 to 3.9 dB by it came to 0.79 to 0.92, one that loses 0.6 to 0.88, a laminate that loses 2.4 to 1.09
# (docs/limits.md). Of 24 to 36 views 18 slices gain, by 0.1 to 4.7 dB, and come to 0.67 to 0.98.
_TIMES = 3.0
# Of a short fit: the longer it is, the less it shows of what smoothing holds back. In a volume fewer of many views do.
# Of a slice it sees so many views at least, in three times the passes at most: 30 views of nickel and steel came to
# 1.03 in 3 passes and to 0.92 in 6, and gain 2.5 dB.
_PASSES, _STEPS, _VIEWS_SEEN = 3.0, 100, 180
# With more rays a voxel a slice's short fits are too early to tell: slices of 3.9, which lose 1.3 dB, would have it.
_MOST_RAYS = 3.0
# Share of the rays that is held out to ask them, in so many views: as few as a run holds out tell their own noise.
_HELD_OUT, _FEWEST_HELD_OUT, _VIEWS, _VIEWS_PLANAR = 0.1, 100, 48, 1000
# A run of fewer passes, as of the fast preset, is in a hurry.
_FEWEST_PASSES = 10.0


def choose_smoothing(
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
    by_depth, by_noise = weights_by_depth(plan.depth, rays)
    plan.tv_factor, thin = by_depth, by_depth < 1
    usual = "the usual weight"
    if thin:
        light = f"{1 - math.exp(-plan.depth):.0%} of the light"
        usual = f"{by_depth:.2g} times {usual}, as soft matter takes away {light} of a typical ray"
    no_more = _why_no_more(problem)
    why_not = _why_not(len(seeds), plan, problem, settings) or ("" if thin else no_more)
    if why_not:
        plan.reasons["smoothing"] = f"{usual}: {why_not}"
        return

    asking = replace(rays, held_out=max(rays.held_out, _HELD_OUT))

    def left_by(factor: float) -> float:
        own = replace(plan, tv_factor=factor)
        passes, views = _PASSES, problem.geometry.views
        if problem.planar:
            passes = min(max(passes, _VIEWS_SEEN / views), 3 * passes)
        else:
            passes = min(passes, _STEPS * views_of_short_steps(plan, problem) / views)
        short = replace(own.adapted(settings), passes=passes, soft_gain=0.0)
        outcome = fitted_shortly(
            seeds.copy(), own, problem, scene, asking, short, options["seed"], options["time_budget"]
        )
        if cut_short(outcome):
            raise Untold(TOO_SHORT)
        return _misfit_aside(
            outcome.gaussians, scene, asking, short, _VIEWS_PLANAR if problem.planar else _VIEWS
        )

    try:
        plan.tv_factor, told = _asked(left_by, [by_depth, by_noise] if thin else [], not no_more)
    except Untold as reason:
        plan.reasons["smoothing"] = f"{usual}: {reason}"
        return
    weight = "the usual weight" if plan.tv_factor == 1 else f"{plan.tv_factor:.2g} times the usual weight"
    plan.reasons["smoothing"] = f"{weight}: after a short fit {told} of the misfit of the held-out rays"
    logger.info("The volume is smoothed with %s", plan.reasons["smoothing"])


def _asked(left_by: Callable[[float], float], less: list[float], more: bool) -> tuple[float, str]:
    """The factor to take, of 1, those ever ``less``, and with ``more`` three, and what each leaves of the misfit."""
    usual = best = left_by(1.0)
    if not usual:
        raise Untold("no ray of those held out is usable")
    chosen, told = 1.0, []

    def ask(factor: float) -> float:
        left = left_by(factor)
        told.append(f"{factor:.2g} times as much leaves {left / usual:.2f}")
        return left

    for factor in less:
        left = ask(factor)
        if left >= _CLEARLY * best:
            break
        chosen, best = factor, left
    if more and chosen == 1 and ask(_TIMES) < usual:
        chosen = _TIMES
    return chosen, " and ".join(told)


@torch.no_grad()
def _misfit_aside(gaussians: Gaussians, scene: FitScene, rays: Rays, settings: Settings, most: int) -> float:
    """Mean misfit of the rays held out in so many views at most; 0 if there are none."""
    total = weighed = 0.0
    for views, measured, _, aside in batches_around(rays, most):
        predicted, _ = scene.projections(gaussians, views)
        weight = float(aside.sum())
        total += weight * float(misfit(predicted, measured, aside, settings))
        weighed += weight
    return total / weighed if weighed else 0.0


def _why_not(seeds: int, plan: Plan, problem: Problem, settings: Settings) -> str:
    """Why no short fits are made, if so."""
    if not (seeds and settings.tv_weight):
        return "there is nothing to smooth"
    if plan.passes < _FEWEST_PASSES:
        return "in so few passes short fits would take too long a part"
    if not problem.planar and problem.geometry.views < FEW_VIEWS:
        return f"fewer than {FEW_VIEWS} views do not tell"
    if not settings.held_out:
        return "no rays are held out"
    if _HELD_OUT * problem.projections.size < _FEWEST_HELD_OUT:
        return f"fewer than {_FEWEST_HELD_OUT / _HELD_OUT:.0f} rays do not tell"
    return ""


def _why_no_more(problem: Problem) -> str:
    """Why more than the usual smoothing is not tried, if so."""
    if not problem.planar:
        return "more is tried in slices only"
    if problem.projections.size > _MOST_RAYS * math.prod(problem.grid.shape):
        return f"more than {_MOST_RAYS:g} rays a voxel need no more"
    return ""
