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

from tomo_polysplat.fit.fitter import Fitter
from tomo_polysplat.fit.optimise import OtherPhysics
from tomo_polysplat.fit.plan import Plan
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.short_fit import RaySample, sample_rays
from tomo_polysplat.fit.stopping import Clock
from tomo_polysplat.physics.ray_estimates import estimate_scatter
from tomo_polysplat.start.initial import FEW_VIEWS

__all__ = ["ScatterSearch", "scatter_search"]

logger = logging.getLogger(__name__)

# Share of the run after which it is asked, and how many of the rays.
_FROM, _RAYS = 0.3, 8000
# Less scatter than this share of the open beam, in every ray, is none: 35 scans without any came to 0.003 at most, but
# for a slice without metal, which short fits then told.
_LEAST = 0.004
# Beside the object, views that differ by more than this share of the most scatter tell of a drifting beam; and the rays
# of a view that tell it, and the views.
_DRIFT, _FEWEST_RAYS, _FEWEST_VIEWS = 0.3, 10, 5
_ASKED = "calibrate=True fits it all the same"
# Steps of the short fits that follow.
_SHORT = 480


@dataclass(frozen=True)
class ScatterSearch:
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
        if not clock.room_for(_SHORT + clock.steps):
            self._tell("not asked: the time budget is kept for the fit")
            return
        rays = sample_rays(fitter.gaussians, fitter.scene, fitter.rays, 0, _RAYS)
        most, drift = self._most(rays, straight=fitter.scene.quadrature is None), _drift(rays)
        if most < _LEAST:
            self._tell(f"none: the rays show {most:.1g} of the open beam at most")
        elif drift is None:
            words = "too few rays pass beside the object to tell it from a drifting beam"
            self._tell(f"not modelled: the rays may show {most:.2g} of the open beam, but {words}; {_ASKED}")
        elif drift > _DRIFT * most:
            words = "the light beside the object differs from view to view, as that of a drifting beam does"
            self._tell(f"not modelled: {words}; {_ASKED}")
        else:
            self._ask(most)

    def _ask(self, most: float) -> None:
        """Have short fits tell it; what ends these does not end the run."""
        try:
            found = self.calibrate()
        except (RuntimeError, FloatingPointError, ValueError) as error:
            # Torch's or ours, of a GPU that has no room for a second cloud, or a fit that did not converge.
            logger.warning("Scatter is not looked for: %s", error)
            self._tell(f"not asked: {error}")
            return
        self.plan.reasons["calibration"] = found
        if found["accepted"]["scatter"]:
            raise OtherPhysics(found)
        self._tell(f"not modelled: the rays may show {most:.2g} of the open beam; {found['why']}")

    def _most(self, rays: RaySample, *, straight: bool) -> float:
        """The most scatter in any ray, as a fraction of the open beam."""
        spectrum, materials = self.problem.spectrum, self.problem.materials
        assert spectrum is not None and materials is not None
        if not len(rays.light):
            return 0.0
        if straight:
            # Without hardening there are no areal densities in g/cm2; beside the object it shows all the same.
            return max(0.0, rays.beam() - 1.0)
        sample = (rays.areal, rays.measured, rays.weight, rays.light)
        scatter = estimate_scatter(*sample, spectrum, materials)
        return float(scatter.at(torch.as_tensor(rays.light)).max())

    def _tell(self, words: str) -> None:
        self.plan.reasons["scatter"] = words
        logger.info("Scatter: %s.", words)


def scatter_search(
    plan: Plan, problem: Problem, calibrate: Callable[[], dict[str, Any]]
) -> ScatterSearch | None:
    """The question where it can be answered; else the plan gets the answer now, unless it has it."""
    if not problem.polychromatic:
        return None
    if problem.geometry.views < FEW_VIEWS:
        plan.reasons.setdefault("scatter", f"not asked: fewer than {FEW_VIEWS} views do not tell")
    return None if "scatter" in plan.reasons else ScatterSearch(plan, problem, calibrate)


def _drift(rays: RaySample) -> float | None:
    """How much the views' light beside the object differs, as far as noise does not explain it; None if unknown."""
    view, values = rays.view[rays.beside].astype(int), rays.measured[rays.beside]
    many = np.bincount(view)
    enough = many >= _FEWEST_RAYS
    if enough.sum() < _FEWEST_VIEWS:
        return None
    means = np.bincount(view, values) / np.maximum(many, 1)
    noise = float((values - means[view]).var()) * float((1 / many[enough]).mean())
    return float(np.sqrt(max(float(means[enough].var()) - noise, 0.0)))
