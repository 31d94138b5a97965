"""Whether the rays hold scattered light, asked once early in a run that nobody has told of any.

It shows in rays that pass beside the object, which are brighter than the open beam, and behind metal. Where there is
some, short fits tell how much (`fit.calibration`), and the run begins anew with it. A beam that drifts shows
beside the object as well: it differs from view to view.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from tomo_polysplat.fit.calibration import describe_scatter, scatter_as_fitted
from tomo_polysplat.fit.fitter import Fitter
from tomo_polysplat.fit.plan import Plan
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.short_fit import RaySample, sample_rays
from tomo_polysplat.fit.stopping import Clock
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.physics.ray_estimates import estimate_scatter
from tomo_polysplat.start.initial import FEW_VIEWS

__all__ = ["OtherPhysics", "ScatterQuestion", "scatter_question"]

logger = logging.getLogger(__name__)

# Share of the run after which it is asked, and how many of the rays.
_FROM, _RAYS = 0.3, 8000
# Less scatter than this share of the open beam, in every ray, is none: scans without any come to 0.0025 at most.
_LEAST = 0.004
# Beside the object, views that differ by more than this share of the most scatter tell of a drifting beam; and the rays
# of a view that tell it, and the views.
_DRIFT, _FEWEST_RAYS, _FEWEST_VIEWS = 0.3, 10, 5
# Steps that the short fits and a new run take, as a share of those of the run and besides.
_ANEW, _SHORT = 1.0, 360


class OtherPhysics(Exception):
    """A run is to begin anew: ``found`` is the record of what told so, ``gaussians`` what it has come to."""

    def __init__(self, found: dict[str, Any], gaussians: Gaussians) -> None:
        super().__init__(found["why"])
        self.found, self.gaussians = found, gaussians


@dataclass(frozen=True)
class ScatterQuestion:
    """The question of one run, whose plan gets the answer.

    Attributes
    ----------
    plan : Plan
    problem : Problem
    calibrate : callable
        Makes the short fits, and returns their record.
    """

    plan: Plan
    problem: Problem
    calibrate: Callable[[], dict[str, Any]]

    def __call__(self, fitter: Fitter, clock: Clock) -> None:
        """Ask it when it is time; where that is too short for what would follow, it is not asked at all.

        Raises
        ------
        OtherPhysics
            If there is scatter.
        """
        if "scatter" in self.plan.reasons or clock.share() < _FROM:
            return
        if clock.room_for(_SHORT + _ANEW * clock.steps):
            self._ask(fitter)
        else:
            self._none("the time budget is kept for the fit")

    def _ask(self, fitter: Fitter) -> None:
        spectrum, materials = self.problem.spectrum, self.problem.materials
        assert spectrum is not None and materials is not None
        rays = sample_rays(fitter.gaussians, fitter.scene, fitter.rays, 0, _RAYS)
        sample = (rays.areal, rays.measured, rays.weight, rays.light)
        scatter = estimate_scatter(*sample, spectrum, materials)
        most = float(scatter.beside(torch.as_tensor(rays.light)).max()) if len(rays.light) else 0.0
        if most < _LEAST:
            self._none(f"the rays show {most:.1g} of the open beam at most")
        elif _drift(rays) > _DRIFT * most:
            words = "the light beside the object differs from view to view, as a beam's drift does"
            self._none(f"{words}; calibrate=True fits it all the same")
        else:
            found = self.calibrate()
            if found["accepted"]["scatter"]:
                raise OtherPhysics(found, fitter.gaussians.copy())
            self._none(f"looked for {describe_scatter(scatter_as_fitted(scatter))}; {found['why']}")

    def _none(self, why: str) -> None:
        self.plan.reasons["scatter"] = f"none: {why}"
        logger.info("Scatter: %s.", self.plan.reasons["scatter"])


def scatter_question(
    plan: Plan, problem: Problem, scene: FitScene, calibrate: Callable[[], dict[str, Any]]
) -> ScatterQuestion | None:
    """The question where it can be answered; else the plan gets the answer now, unless it has it."""
    why_not = ""
    if not problem.polychromatic:
        return None
    if scene.quadrature is None:
        why_not = "with rays that are straight sums nothing tells it from matter"
    elif problem.geometry.views < FEW_VIEWS:
        why_not = f"fewer than {FEW_VIEWS} views do not tell"
    if why_not:
        plan.reasons.setdefault("scatter", f"none: {why_not}")
    return None if "scatter" in plan.reasons else ScatterQuestion(plan, problem, calibrate)


def _drift(rays: RaySample) -> float:
    """Standard deviation of the views' light beside the object, as far as noise does not explain it; 0 if unknown."""
    view, values = rays.view[rays.beside].astype(int), rays.measured[rays.beside]
    many = np.bincount(view)
    enough = many >= _FEWEST_RAYS
    if enough.sum() < _FEWEST_VIEWS:
        return 0.0
    means = np.bincount(view, values)[enough] / many[enough]
    within = values - (np.bincount(view, values) / np.maximum(many, 1))[view]
    noise = float(within.var()) * float((1 / many[enough]).mean())
    return float(np.sqrt(max(float(means.var()) - noise, 0.0)))
