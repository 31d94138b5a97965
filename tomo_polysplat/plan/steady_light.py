"""Gains of the pixels and drift of the source, told by the rays between passes of a run, and taken out of them.

What was measured is changed, in place, and not the model: no kernel knows of it. Each time the whole of them is
told anew, so that what was wrong at first, when the fit was rough, does not stay.
"""

from __future__ import annotations

import logging
from functools import partial

from tomo_polysplat.fit.optimise import Run
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.residual_sums import residual_sums
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.light_told import ask_gains_again, ask_light, wanted_light
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.settings import Settings

__all__ = ["SteadyLight"]

logger = logging.getLogger(__name__)

# Shares of the run after which the rays are asked, and how often in vain.
_SHARES, _IN_VAIN = (0.1, 0.2, 0.3, 0.45, 0.6, 0.8), 3


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
        self.problem, self.plan, self.settings = problem, plan, settings
        self.wanted = wanted_light(settings)
        self.asked = 0
        for name, wanted in self.wanted.items():
            if wanted is False:
                plan.facts[name] = Answer(0.0, "asked for", Status.GIVEN)
            elif name in plan.facts:
                self.asked = max(self.asked, int(plan.facts[name].evidence.get("asked", 0)))

    def between(self, run: Run) -> None:
        """Ask the rays, where it is time; once gains are taken out, about them after every pass."""
        share, before = run.clock.share(), self.asked
        while self.asked < len(_SHARES) and share >= _SHARES[self.asked]:
            self.asked += 1
        if share >= 1 or not self.asked or all(wanted is False for wanted in self.wanted.values()):
            return
        again = self.asked == before
        if again and not self.problem.taken.gains.any() or self._in_vain(before):
            return
        fitter, taken = run.fitter, self.problem.taken
        before_it = len(taken.steps)
        sums = partial(residual_sums, fitter.gaussians, fitter.scene, fitter.rays, fitter.settings)
        asking = ask_gains_again if again else ask_light
        for name, told in asking(self.problem, sums, self.settings).items():
            if again and not told.kept:
                continue
            if told.change.any():
                taken.add(**{name: told.change})
            answer = told.answer(asked=self.asked)
            self.plan.facts[name] = answer
            kept = "taken out" if told.kept else "none"
            logger.log(
                logging.DEBUG if again else logging.INFO, "%s: %s, %s.", name.capitalize(), kept, answer.why
            )
        if len(taken.steps) > before_it:
            # As a run that goes on from a checkpoint weighs them.
            fitter.rays.weigh_anew()

    def _in_vain(self, asked: int) -> bool:
        """Whether it was asked often enough for nothing."""
        told = [self.plan.facts[name].value for name in self.wanted if name in self.plan.facts]
        return asked >= _IN_VAIN and not any(told)
