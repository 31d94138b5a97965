"""Fewer Gaussians, where a time budget has no room for the whole run with as many as the scan is worth.

A run that ends early leaves its Gaussians short of where they belong. Fewer of them, which make more steps, show more.
What is lacking is taken from both alike (docs/decisions/seed_spacing.md).
"""

from __future__ import annotations

import logging
import math
from dataclasses import replace

import numpy as np

from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.fit.fitter import Batches, Fitter, steps_of_a_run
from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.kernels.compile_time import working_time
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.plan.decisions.finer_seeds import FinerSeeds
from tomo_polysplat.plan.decisions.passes import Passes
from tomo_polysplat.plan.decisions.seed_spacing import SeedSpacing
from tomo_polysplat.plan.decisions.smallest_scale import SmallestScale
from tomo_polysplat.plan.decisions.tv_every import TvEvery
from tomo_polysplat.plan.decisions.views_per_step import ViewsPerStep
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.model import scene_of
from tomo_polysplat.plan.order import decide_start
from tomo_polysplat.plan.resolution import FEWEST_SEEDS

__all__ = ["seed_for_time"]

logger = logging.getLogger(__name__)

# What depends on the number of Gaussians, and is decided again.
_AGAIN = (SeedSpacing, FinerSeeds, SmallestScale, Passes, ViewsPerStep, TvEvery)
# Steps that are timed after a first one, unless these take more than a share of the time that is left.
_TIMED, _MOST = 2, 0.05


def seed_for_time(lab: Lab, end: float) -> None:
    """Lower the number of seeds in the plan by the square root of what there is room for by then.

    Parameters
    ----------
    lab : Lab
        With a start, and what that tells. Nothing is done where the caller says how many Gaussians, or how close.
    end : float
        When the reconstruction is to be over, in seconds of ``kernels.compile_time.working_time``.
    """
    if lab.settings.max_gaussians or lab.settings.seed_spacing or end <= working_time():
        return
    seeds = lab.seeds()
    # The seeds may have taken what was left, and no step can be timed then.
    if not len(seeds) or (left := end - working_time()) <= 0:
        return
    needed = _seconds_of_run(lab, seeds, left)
    room = max(end - working_time(), 0.0) / needed
    if room >= 1:
        return
    many = max(int(math.sqrt(room) * len(seeds)), FEWEST_SEEDS**lab.problem.dimensions)
    if many >= len(seeds):
        return
    lab.settings = replace(lab.settings, max_gaussians=many)
    for decision in _AGAIN:
        del lab.plan.answers[decision.name]
    decide_start(lab)
    words = f"at most, for {len(seeds)} of which the time budget has room for {room:.0%} of the run"
    lab.plan.note("seeds_in_time", many, words)
    logger.info("Gaussians: %d %s.", many, words)


def _seconds_of_run(lab: Lab, seeds: Gaussians, left: float) -> float:
    """What all steps of the run would take with these, by the pace of some, for a part of what is ``left``."""
    plan, views = lab.plan, len(lab.rays.views)
    batch = min(plan.views_per_step, views)
    steps = steps_of_a_run(plan.passes, lab.rays, batch)
    spacing = plan.spacing * lab.problem.voxel
    # Not the lab's: that is of the plan with as many Gaussians as there will be.
    scene = scene_of(lab.problem, plan, lab.settings, lab.device)
    setup = FitSetup(seeds.copy(), spacing, lab.rays, scene, plan.adapted(lab.seeding))
    fitter = Fitter(setup, Batches(batch, steps, np.random.default_rng(0)))
    some, took = evenly_spread(views, batch), list[float]()
    while len(took) <= _TIMED and sum(took) <= _MOST * left:
        begun = working_time()
        fitter.step(some, 0.0)
        fitter.settle()
        took.append(working_time() - begun)
    # What the first step waits for is no pace.
    return max(float(np.mean(took[1:] or took)) * steps, 1e-9)
