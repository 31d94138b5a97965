"""Whether light soft matter is fat or thin water, asked of the rays in the middle of a run.

Fat hardens the beam less than water. A fit makes up for most of that by density, and levels of the volume do not tell
the two apart; but where there is much fat, and not all of it near the rim, rays that meet it after more or less of
other matter disagree about its density.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from tomo_polysplat.fit.fitter import Fitter
from tomo_polysplat.fit.fork import Made, fork, passes_of_a_fork, why_no_fork
from tomo_polysplat.fit.light_matter import light_gaussians, tell_light
from tomo_polysplat.fit.loss import misfit
from tomo_polysplat.fit.plan import Plan
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import batches_around
from tomo_polysplat.fit.stopping import Clock
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.settings import Settings

__all__ = ["FatQuestion", "fat_question"]

logger = logging.getLogger(__name__)

# Share of the run after which it is asked, and the steps of each way, but for more than this share of the run: what has
# been water for half of a run takes some 70 steps to come to terms with being fat.
_FROM, _STEPS, _MOST = 0.5, 100, 0.27
# Less of the mass outside metal matters little, and tells nothing.
_LEAST = 0.1
# Fewer voxels along the longest edge do not tell, nor do slices: their steps are too few (pancreas of 28^3, 32^3, 40^3
# and 56^3: +4.5, +7.0, -0.3 and -2.4 %; of water in the place of its fat +2.2 and +3.1 % at the last two).
_FEWEST_VOXELS = 48
# What lies so far from the number that soft matter began with has shown that it is no water.
_MOVED = 0.01
# So many times its standard error, over the views, the misfit must be less as fat.
_CERTAIN = 2.0

_ONE_CURVE = "there is one material curve"


@dataclass(frozen=True)
class FatQuestion:
    """The question of one run, whose plan gets the answer; see `fit.fork.Question`."""

    plan: Plan
    light_u: float

    def due(self, clock: Clock) -> bool:
        """Whether it is to be asked now."""
        return self.plan.fat is None and clock.share() >= _FROM

    def answered(self, fitter: Fitter, clock: Clock) -> tuple[Fitter, Made | None]:
        """The fitter to go on with, some passes later, and what the last of them gave, if there were any."""
        passes = passes_of_a_fork(fitter, self.plan.passes, _STEPS, _MOST)
        if not clock.room_for(clock.steps - clock.done + passes * fitter.steps_of_a_pass):
            return self._not_asked(fitter, "the time budget is kept for the fit"), None
        if (share := _light_mass(fitter)) < _LEAST:
            return self._not_asked(fitter, f"{share:.0%} of the mass is light: too little to matter"), None
        if abs(fitter.gaussians.shared_material[0].item() - self.plan.soft_u) > _MOVED:
            return self._not_asked(fitter, "the soft matter has found a number of its own"), None
        try:
            other = fitter.branch(light_u=self.light_u)
        except RuntimeError as full:
            # Torch's, of a GPU that has no room for a second cloud.
            return self._not_asked(fitter, f"{full}"), None
        tell_light(other.gaussians, other.scene, clock.share())
        ways = fork(fitter, other, clock, passes)
        if ways.late:
            why = "the time budget was used before the rays could tell"
            return self._not_asked(fitter, why), ways.was
        less, error = _difference(*_misfits([fitter, other]))
        self.plan.fat = less > _CERTAIN * error
        kind = "fat" if self.plan.fat else "less dense soft matter"
        words = f"{kind}: as fat it leaves {-less:+.2%} of the misfit, give or take {error:.2%}"
        self.plan.reasons["light"] = f"{words} ({share:.0%} of the mass is light)"
        logger.info("Light matter is %s.", self.plan.reasons["light"])
        return (other, ways.other) if self.plan.fat else (fitter, ways.was)

    def _not_asked(self, fitter: Fitter, why: str) -> Fitter:
        _taken_for_soft(self.plan, why)
        return fitter


def fat_question(
    plan: Plan, problem: Problem, gaussians: Gaussians, settings: Settings
) -> FatQuestion | None:
    """The question where it can be answered; else the plan gets the answer now.

    Parameters
    ----------
    plan : Plan
        Of a run that begins, or goes on from a checkpoint.
    problem : Problem
    gaussians : Gaussians
        That it begins with.
    settings : Settings
    """
    if settings.light != "auto":
        of_no_use = f", of no effect: {_ONE_CURVE}" if plan.fat and plan.curves == 1 else ""
        plan.reasons["light"] = f"{settings.light}: asked for{of_no_use}"
    if plan.fat is not None:
        return None
    why_not = _why_not(plan, problem, gaussians, settings)
    if not why_not:
        plan.reasons["alternatives"]["light"] = (
            "soft or fat: not asked in the middle of the run, which takes an eighth more steps,"
            " or a quarter where they are few"
        )
        return FatQuestion(plan, settings.light_u)
    _taken_for_soft(plan, why_not)
    return None


def _why_not(plan: Plan, problem: Problem, gaussians: Gaussians, settings: Settings) -> str:
    """Why it is not asked, if so."""
    if plan.curves == 1 or not len(gaussians):
        return _ONE_CURVE
    if not settings.light_u:
        return "its number would be that of other soft matter"
    if plan.soft_u or problem.materials != Materials():
        return "fat is told from water only"
    if problem.planar or max(problem.grid.shape) < _FEWEST_VOXELS:
        return f"slices, and volumes of fewer than {_FEWEST_VOXELS} voxels along an edge, do not tell"
    return why_no_fork(plan.passes, problem.geometry.views)


def _taken_for_soft(plan: Plan, why: str) -> None:
    plan.fat = False
    plan.reasons["light"] = f"less dense soft matter, not asked: {why}"


@torch.no_grad()
def _light_mass(fitter: Fitter) -> float:
    """Share of the mass outside metal that is light."""
    gaussians = fitter.gaussians
    mass = gaussians.attenuation * gaussians.log_scale.sum(dim=1).exp()
    light = light_gaussians(gaussians, fitter.scene)
    return float(mass[light].sum() / mass[gaussians.group <= 0].sum().clamp(min=torch.finfo(mass.dtype).tiny))


@torch.no_grad()
def _misfits(fitters: Sequence[Fitter]) -> list[np.ndarray]:
    """Misfit of the fitted rays of each of some views around the object, by each of the fitters."""
    found: list[list[float]] = [[] for _ in fitters]
    for views, measured, weight, _ in batches_around(fitters[0].rays):
        for k, fitter in enumerate(fitters):
            predicted, _ = fitter.scene.projections(fitter.gaussians, views)
            for parts in zip(predicted.split(1), measured.split(1), weight.split(1)):
                found[k].append(float(misfit(*parts, fitter.settings)))
    return [np.array(values) for values in found]


def _difference(was: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """By what share of the first the other misfit is less, and its standard error over the views."""
    less = was - other
    return float(less.mean() / was.mean()), float(less.std(ddof=1) / math.sqrt(len(less)) / was.mean())
