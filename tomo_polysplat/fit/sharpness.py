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

from tomo_polysplat.fit.loss import misfit
from tomo_polysplat.fit.plan import Plan, finest_spacing
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.short_fit import batches_around, fitted_shortly
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings
from tomo_polysplat.start.initial import FEW_VIEWS

__all__ = ["edges_are_sharp"]

logger = logging.getLogger(__name__)

# Thin seeds are taken where they leave less than this share of the misfit that round ones leave. 23 scans of objects
# with sharp edges (24^3 to 48^3 voxels) came to 0.69 to 0.95, those of broccoli, which gains and loses nothing, to 0.97
# and 0.99, and nine of blurred ones, which lose 0.4 to 4 dB by thin seeds, to 0.98 and more.
_SHARP = 0.96
# A short fit is a pass over the views, or so many of them: 40 views in steps of one came to 0.75 to 0.97 by the seed,
# and in 1.8 passes to 0.67 to 0.81.
_FEWEST_VIEWS = 72
# Seeds so many times as far apart as the detector could tell are thin as it is, and gain less by being thinner than
# the short fits cost (teeth of 64^3 and 96^3, 1.0 and 1.3 times as far: 0.9 and 1.7 dB; six scenes of 256^3: 0.1 dB).
_FARTHEST = 1.35
# Fewer voxels along the longest edge show no edge so sharp that it would pay (24^3 and 28^3: -0.2 to 0.0 dB by thin
# seeds, though the rays are fitted better).
_FEWEST_VOXELS = 30
# A run of fewer passes, as of the fast preset, is in a hurry.
_FEWEST_PASSES = 6.0


def edges_are_sharp(
    start: torch.Tensor,
    plan: Plan,
    problem: Problem,
    settings: Settings,
    device: torch.device,
    options: Mapping[str, Any],
) -> tuple[bool, str]:
    """Whether seeds are to be thin across edges, however close they are, and why.

    Parameters
    ----------
    start : (nz, ny, nx) tensor
        First reconstruction in the solver's units (``Problem.start_volume``).
    plan : Plan
    problem : Problem
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
    if settings.edges != "auto":
        return settings.edges == "sharp", "asked for"
    why_not = _why_not(plan, problem, settings)
    if why_not:
        return False, why_not
    passes = max(1.0, _FEWEST_VIEWS / problem.geometry.views)
    short = replace(settings, passes=passes, soft_gain=0.0, tv_weight=0.0)
    scene, rays = problem.scene(plan, short, device), problem.rays(plan, short, device)
    misfits = []
    for sharp in (False, True):
        # Plans of their own, as the seeds are written down there.
        own = replace(plan, sharp=sharp, reasons=dict(plan.reasons))
        seeds = problem.seeds(start, own, short, device)
        if not len(seeds):
            return False, "there are no seeds: the start volume is empty"
        outcome = fitted_shortly(
            seeds, own, problem, scene, rays, short, options["seed"], options["time_budget"]
        )
        if outcome.reason.startswith("the time budget"):
            return False, "round seeds: the time budget is too short to tell how sharp edges are"
        misfits.append(_misfit(outcome.gaussians, scene, rays, short))
    return _judged(*misfits)


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
