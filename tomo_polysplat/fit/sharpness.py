"""Whether an object's edges are as sharp as the detector could show, told by two short fits.

Seeds that are thin across the edges of the start make sharp edges sharper than round ones do, and edges that are
blurred, as those of a breathing patient, too sharp: a fit does not undo that. Neither the start nor the detector's
resolution tells which of the two an object has; the rays do, after one pass over the views from either kind of seed.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from tomo_polysplat.fit.detail import Tried, why_not_asked
from tomo_polysplat.fit.first_gaussians import first_gaussians, room_to_grow
from tomo_polysplat.fit.loss import misfit
from tomo_polysplat.fit.optimise import FitOutcome
from tomo_polysplat.fit.plan import Plan
from tomo_polysplat.fit.plan_seeds import closer_spacing, finest_spacing
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import Rays, batches_around
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.short_fit import TOO_SHORT, cut_short, fitted_shortly, views_of_short_steps
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings
from tomo_polysplat.start.initial import FEW_VIEWS

__all__ = ["seeds_for_edges"]

logger = logging.getLogger(__name__)

# Thin seeds are taken where they leave less than this share of the misfit that round ones leave. 34 scans of objects
# with sharp edges (24^3 to 256^3 voxels) came to 0.69 to 0.95, those of broccoli, which gains and loses nothing, to
# 0.95 to 0.99, and 20 of blurred ones, of which many lose by thin seeds, up to 4 dB, to 0.98 and more.
_SHARP = 0.96
# A short fit is a pass over the views, which need not have more steps than this, but has so many views: 40 views in
# steps of one came to 0.75 to 0.97 by the seed, and in 1.8 passes to 0.67 to 0.81.
_STEPS, _FEWEST_VIEWS = 40, 72
# Seeds so many times as far apart as the detector could tell are thin as it is, and gain less by being thinner than
# the short fits cost (teeth of 96^3, 128^3 and 256^3, 1.3, 1.4 and 2.1 times as far: 2.0, 1.8 and 0.3 dB).
_FARTHEST = 1.8
# Fewer voxels along the longest edge show no edge so sharp that it would pay (24^3 and 28^3: -0.2 to 0.0 dB by thin
# seeds, though the rays are fitted better).
_FEWEST_VOXELS = 30
# A run of fewer passes, as of the fast preset, is in a hurry.
_FEWEST_PASSES = 6.0


def seeds_for_edges(
    start: torch.Tensor,
    plan: Plan,
    problem: Problem,
    scene: FitScene,
    rays: Rays,
    settings: Settings,
    device: torch.device,
    options: Mapping[str, Any],
) -> tuple[Plan, Gaussians, Tried | None]:
    """Seeds of a start volume, thin across sharp edges however close they are, and the plan with what was told.

    And the short fit of seeds of that kind, no closer than the others, if there was one.

    Parameters
    ----------
    start : (nz, ny, nx) tensor
        First reconstruction in the solver's units (``fit.first_volume``).
    plan : Plan
        Its ``sharp`` is not looked at.
    problem : Problem
    scene, rays : FitScene, Rays
        The problem's.
    settings : Settings
        Of the fit to come.
    device : torch.device
    options : mapping
        ``seed`` and ``time_budget`` of the reconstruction.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C.
    """

    def of_kind(sharp: bool) -> tuple[Plan, Gaussians]:
        # Plans of their own, as the seeds are written down there.
        own = replace(plan, sharp=sharp, reasons=dict(plan.reasons))
        return own, first_gaussians(start, own, problem, settings, device)

    def closer(sharp: Plan, seeds: Gaussians) -> tuple[Plan, Gaussians]:
        spacing, why = closer_spacing(sharp.spacing, len(seeds), settings)
        if not why:
            return sharp, seeds
        reasons = sharp.reasons | {"seed_spacing_voxels": f"{spacing:.2f}: {why}"}
        own = replace(sharp, spacing=spacing, reasons=reasons)
        return own, first_gaussians(start, own, problem, settings, device)

    views = problem.geometry.views
    passes = max(_FEWEST_VIEWS, min(views, _STEPS * views_of_short_steps(plan, problem))) / views
    short = replace(settings, passes=passes, soft_gain=0.0, tv_weight=0.0)

    def fitted(own: Plan, seeds: Gaussians) -> FitOutcome:
        return fitted_shortly(
            seeds.copy(), own, problem, scene, rays, short, options["seed"], options["time_budget"]
        )

    def tried(own: Plan, outcome: FitOutcome) -> Tried | None:
        def of_closer(factor: float) -> Gaussians | None:
            many = replace(own, spacing=factor * own.spacing, reasons=dict(own.reasons))
            found = fitted(many, first_gaussians(start, many, problem, settings, device))
            return None if cut_short(found) else found.gaussians

        if cut_short(outcome):
            return None
        return Tried(outcome.gaussians, of_closer, room_to_grow(len(outcome.gaussians), own, problem, device))

    if settings.edges != "auto":
        kind = of_kind(settings.edges == "sharp")
        shown = None
        if len(kind[1]) and not (why_not_asked(kind[1], plan, settings) or _why_not(plan, problem, settings)):
            shown = tried(kind[0], fitted(*kind))
        return *_because(*(closer(*kind) if kind[0].sharp else kind), "asked for"), shown
    plain = of_kind(False)
    why_not = _why_not(plan, problem, settings)
    if why_not or not len(plain[1]):
        return *_because(*plain, why_not or "there are no seeds: the start volume is empty"), None
    kinds, misfits, outcomes = (plain, of_kind(True)), [], []
    for kind in kinds:
        outcome = fitted(*kind)
        if cut_short(outcome):
            return *_because(*plain, f"round seeds: {TOO_SHORT} how sharp edges are"), None
        misfits.append(_misfit(outcome.gaussians, scene, rays, short))
        outcomes.append(outcome)
    sharp, reason = _judged(*misfits)
    shown = tried(kinds[sharp][0], outcomes[sharp])
    return *_because(*(closer(*kinds[True]) if sharp else plain), reason), shown


def _because(plan: Plan, seeds: Gaussians, reason: str) -> tuple[Plan, Gaussians]:
    plan.reasons["edges"] = reason
    return plan, seeds


def _why_not(plan: Plan, problem: Problem, settings: Settings) -> str:
    """Why no short fits are made, if so."""
    if not settings.seed_edge:
        return "round seeds: asked for"
    if settings.seed_spacing:
        return "round seeds: their distance was asked for"
    if problem.planar:
        return "round seeds: slices gain nothing by thin ones"
    if plan.spacing > _FARTHEST * finest_spacing(problem)[0]:
        return "seeds as thin as the detector could tell apart, across edges: they are far from each other"
    if max(problem.grid.shape) < _FEWEST_VOXELS:
        return f"round seeds: fewer than {_FEWEST_VOXELS} voxels along an edge gain nothing by thin ones"
    if plan.passes < _FEWEST_PASSES:
        return "round seeds: in so few passes two short fits would take too long a part"
    if problem.geometry.views < FEW_VIEWS:
        return f"round seeds: fewer than {FEW_VIEWS} views do not tell how sharp edges are"
    return ""


def _judged(of_round: float, of_thin: float) -> tuple[bool, str]:
    share = of_thin / of_round if of_round else 1.0
    sharp = share < _SHARP
    kind = "sharp, and seeds thin across them" if sharp else "not sharp enough for thin seeds"
    reason = f"{kind}: after a short fit these leave {share:.2f} of the misfit that others leave"
    logger.info("Edges are %s", reason)
    return sharp, reason


@torch.no_grad()
def _misfit(gaussians: Gaussians, scene: FitScene, rays: Rays, settings: Settings) -> float:
    """Mean misfit of the fitted rays of some views."""
    misfits = []
    for views, measured, weight, _ in batches_around(rays):
        predicted, _ = scene.projections(gaussians, views)
        misfits.append(float(misfit(predicted, measured, weight, settings)))
    return float(np.mean(misfits))
