"""Gains of the pixels and drift of the source, told by the rays between passes of a run, and taken out of them.

What was measured is changed, in place, and not the model: no kernel knows of it. Each time the whole of them is
told anew, so that what was wrong at first, when the fit was rough, does not stay.
"""

from __future__ import annotations

import logging
import math

import numpy as np

from tomo_polysplat.fit.optimise import Run
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.residual_sums import ResidualSums, residual_sums
from tomo_polysplat.nuisances.drift import Drift
from tomo_polysplat.nuisances.gain_estimate import drift_of_views, gains_of_pixels, less_rings
from tomo_polysplat.nuisances.gains import Gains
from tomo_polysplat.nuisances.nuisance import Nuisance
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.settings import Settings

__all__ = ["SteadyLight"]

logger = logging.getLogger(__name__)

# Shares of the run after which the rays are asked, and how often in vain.
_SHARES, _IN_VAIN = (0.1, 0.2, 0.3, 0.45, 0.6, 0.8), 3
# Held-out rays that tell anything.
_FEWEST_RAYS = 30
_KINDS: tuple[type[Nuisance], ...] = (Drift, Gains)


class SteadyLight:
    """What asks a run for them.

    Parameters
    ----------
    problem : Problem
        Whose measured rays are corrected.
    plan : Plan
        Gets a fact for each; those that it has, of a checkpoint, tell how often they were asked for.
    settings : Settings
    """

    def __init__(self, problem: Problem, plan: Plan, settings: Settings) -> None:
        self.problem, self.plan = problem, plan
        self.corner = settings.huber_corner
        self.wanted = {kind.name: getattr(settings, kind.name) for kind in _KINDS}
        self.asked = 0
        for name, wanted in self.wanted.items():
            if wanted is False:
                plan.facts[name] = Answer(0.0, "asked for", Status.GIVEN)
            elif name in plan.facts:
                self.asked = max(self.asked, int(plan.facts[name].evidence.get("asked", 0)))

    def between(self, run: Run) -> None:
        """Ask the rays, where it is time."""
        share, before = run.clock.share(), self.asked
        while self.asked < len(_SHARES) and share >= _SHARES[self.asked]:
            self.asked += 1
        if self.asked == before or share >= 1 or self._in_vain(before):
            return
        if all(wanted is False for wanted in self.wanted.values()):
            return
        fitter, before_it = run.fitter, len(self.problem.taken.steps)
        sums = residual_sums(fitter.gaussians, fitter.scene, fitter.rays, fitter.settings)
        if self.wanted[Drift.name] is not False:
            taken = self.problem.taken.drift
            found = drift_of_views(sums.count, sums.by_depth + sums.count * taken[:, None])
            change = self._judge(Drift, found, taken, sums, sums.view)
            sums = sums.without_drift(change)
        if self.wanted[Gains.name] is not False:
            taken = self.problem.taken.gains
            found = gains_of_pixels(sums.weight, sums.total + sums.weight * taken)
            axis = _axis_column(self.problem)
            # An axis that no view sees makes no rings.
            found = less_rings(found, axis) if math.isfinite(axis) else found
            self._judge(Gains, found, taken, sums, sums.pixel)
        if len(self.problem.taken.steps) > before_it:
            # As a run that goes on from a checkpoint weighs them.
            fitter.rays.weigh_anew()

    def _in_vain(self, asked: int) -> bool:
        """Whether it was asked often enough for nothing."""
        told = [self.plan.facts[name].value for name in self.wanted if name in self.plan.facts]
        return asked >= _IN_VAIN and not any(told)

    def _judge(
        self,
        kind: type[Nuisance],
        found: np.ndarray,
        taken: np.ndarray,
        sums: ResidualSums,
        where: np.ndarray,
    ) -> np.ndarray:
        """Take out what was found as far as held-out rays confirm it; by how much that changes what was taken."""
        evidence = _evidence(found, taken, sums, where, self.corner)
        verdict = kind.gate(evidence)
        kept = verdict.kept or (self.wanted[kind.name] is True and evidence["rms"] > 0)
        change = found - taken if kept else -taken
        if change.any():
            self.problem.taken.add(**{kind.name: change})
        value = evidence["rms"] if kept else 0.0
        told = {name: number for name, number in evidence.items() if math.isfinite(number)}
        told["asked"] = float(self.asked)
        self.plan.facts[kind.name] = Answer(value, verdict.why, Status.ASKED, told)
        logger.info("%s: %s, %s.", kind.name.capitalize(), "taken out" if kept else "none", verdict.why)
        return change


def _axis_column(problem: Problem) -> float:
    """Where the axis of rotation is seen, in the mean of the views."""
    seen = problem.geometry.project_points(-problem.centre[None] / problem.length)
    return float(np.mean(seen[..., 0]))


def _evidence(
    found: np.ndarray, taken: np.ndarray, sums: ResidualSums, where: np.ndarray, corner: float
) -> dict[str, float]:
    """How much better the held-out rays are explained, each with what was found and without any."""
    rays, rms = len(sums.residual), float(np.sqrt(np.mean(found**2)))
    if rays < _FEWEST_RAYS:
        return {"rms": rms, "better": math.nan, "error": math.nan}
    without = sums.residual + taken.ravel()[where]
    left = (without, without - found.ravel()[where])
    before, after = (_misfit(residual / sums.deviation, corner) for residual in left)
    mean = max(float(before.mean()), 1e-300)
    better, error = float((before - after).mean()), float((before - after).std()) / math.sqrt(rays)
    return {"rms": rms, "better": better / mean, "error": error / mean}


def _misfit(deviations: np.ndarray, corner: float) -> np.ndarray:
    """Huber's, with the corner that the fit has (`fit.loss.weighted_huber`), ray by ray."""
    size = np.abs(deviations)
    return np.where(size < corner, 0.5 * size**2, corner * (size - 0.5 * corner))
