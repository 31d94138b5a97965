"""Whether the rays hold scattered light, asked once early in a run that nobody has told of any.

It shows in rays that pass beside the object, which are brighter than the open beam, and behind metal. Where there is
some, short fits tell how much (`plan.calibration`), and the run begins anew with it. A beam that drifts shows
beside the object as well: it differs from view to view.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import torch

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.nuisances.scatter import ScatteredLight
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known, When, is_number
from tomo_polysplat.plan.lab import Lab, Untold
from tomo_polysplat.plan.ray_sample import RaySample, sample_rays
from tomo_polysplat.settings import Settings
from tomo_polysplat.start.initial import FEW_VIEWS

__all__ = ["Scattering"]

logger = logging.getLogger(__name__)

# Share of the run after which it is asked, and how many of the rays.
_FROM, _RAYS = 0.3, 8000
# Rays of a view beside the object that tell its light, and views that tell a drift.
_FEWEST_RAYS, _FEWEST_VIEWS = 10, 5
# Views differ where noise explains it by a chance of so many deviations only.
_DEVIATIONS = 3.0
# Steps of the short fits that follow, of a volume and of one slice.
_SHORT, _SHORT_PLANAR = 480, 1920


class Scattering(Decision):
    """Do the rays hold scattered light?

    What was fitted, as `plan.calibrated_physics.with_fitted` takes it; empty for none.
    """

    name = "scatter"
    when = When.DURING
    share = _FROM

    def given(self, settings: Settings) -> Any | None:
        """The argument ``calibrate`` of `reconstruct` says it."""
        return None

    def valid(self, value: Any) -> bool:
        """Names and numbers."""
        return isinstance(value, dict) and all(is_number(number) for number in value.values())

    def usual(self, known: Known, lab: Lab) -> dict[str, float]:
        """None."""
        return {}

    def why_not(self, known: Known, lab: Lab) -> str:
        """Why it is not asked, if so."""
        if lab.calibrate is None:
            return "not looked for: asked for"
        if not lab.problem.polychromatic:
            return "not looked for under one energy"
        return f"fewer than {FEW_VIEWS} views do not tell" if lab.problem.geometry.views < FEW_VIEWS else ""

    def ask(self, known: Known, lab: Lab) -> Answer:
        """The rays in the middle of the run; where they show some, short fits, and the run begins anew with it."""
        run = lab.run
        assert run is not None
        short = _SHORT_PLANAR if lab.problem.planar else _SHORT
        if not run.clock.room_for(short + run.clock.steps):
            raise Untold("the time budget is kept for the fit")
        fitter = run.fitter
        rays = sample_rays(fitter.gaussians, fitter.scene, fitter.rays, 0, _RAYS)
        evidence, drift = _shown(rays, lab.problem, straight=fitter.scene.quadrature is None), _drift(rays)
        evidence |= {} if drift is None else {"drift": drift}
        suspected = ScatteredLight.suspected(evidence)
        return _by_short_fits(lab, evidence) if suspected.kept else _none(suspected.why, evidence)


def _none(why: str, evidence: dict[str, float]) -> Answer:
    logger.info("Scatter is not modelled: %s.", why)
    return Answer({}, why, Status.ASKED, evidence)


def _by_short_fits(lab: Lab, evidence: dict[str, float]) -> Answer:
    """What short fits tell; what ends these does not end the run."""
    assert lab.calibrate is not None and lab.run is not None
    try:
        found = lab.calibrate()
    except (RuntimeError, FloatingPointError, ValueError, MemoryError) as error:
        # Torch's or ours, of a GPU that has no room for a second cloud, or a fit that did not converge.
        logger.warning("Scatter is not looked for: %s", error)
        raise Untold(f"{error}") from error
    lab.plan.note("calibration", found, found["why"])
    if found["accepted"]["scatter"]:
        lab.run.restart = found
        return Answer(found["fitted"], found["why"], Status.ASKED, evidence)
    return _none(f"the rays may show {evidence['most']:.2g} of the open beam; {found['why']}", evidence)


def _shown(rays: RaySample, problem: Problem, *, straight: bool) -> dict[str, float]:
    """The most scatter in any ray, as a fraction of the open beam, and how much of the rays' misfit it would leave."""
    if not len(rays.light):
        return {"most": 0.0, "left": 1.0}
    # Without hardening there are no areal densities in g/cm2.
    model = (None, None) if straight else (problem.spectrum, problem.materials)
    shown = min(ScatteredLight.shown(0.0, rays.fitted, *model), key=lambda one: one.left)
    return {"most": float(shown.scatter.at(torch.as_tensor(rays.light)).max()), "left": shown.left}


def _drift(rays: RaySample) -> float | None:
    """How much the views' light beside the object differs, as far as noise does not explain it; None if unknown."""
    view, values = rays.view[rays.beside].astype(int), rays.measured[rays.beside]
    many = np.bincount(view)
    enough = many >= _FEWEST_RAYS
    if enough.sum() < _FEWEST_VIEWS:
        return None
    means = np.bincount(view, values) / np.maximum(many, 1)
    noise = float((values - means[view]).var()) * float((1 / many[enough]).mean())
    # The variance of so many means has an error of its own.
    noise *= 1 + _DEVIATIONS * float(np.sqrt(2 / enough.sum()))
    return float(np.sqrt(max(float(means[enough].var()) - noise, 0.0)))
