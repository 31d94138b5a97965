"""How many views make one step of the optimiser."""

from __future__ import annotations

import math
from typing import Any

from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known
from tomo_polysplat.plan.decisions.passes import Passes, longer, times_of_few_views, usual_passes
from tomo_polysplat.plan.decisions.seed_spacing import MOST_VIEWS, SeedSpacing
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.settings import Settings

__all__ = ["ViewsPerStep"]

# Fewer steps than this leave edges blurred; more of one view each are noisier than fewer of several. A GPU, whose
# steps cost little, makes more of them. The few rays of a planar view do with fewer steps (five fan-beam slices: 38.0
# dB with 4 views a step, 38.3 with 8).
_STEPS, _STEPS_PLANAR = 360, 300
_MOST_VIEWS_PLANAR = 8
# Passes that the number of steps is for.
_PASSES = 15.0


class ViewsPerStep(Decision):
    """How many views make one step of the optimiser?

    As many as leave enough steps.
    """

    name = "views_per_step"
    needs = (Passes, SeedSpacing)

    def given(self, settings: Settings) -> Any | None:
        """There may be fewer views than the settings say; see `ask`."""
        return None

    def valid(self, value: object) -> bool:
        """A whole number."""
        return type(value) is int and value > 0

    def alternative(self, lab: Lab) -> str:
        """Fewer."""
        views = lab.plan.views_per_step
        if views < 2:
            return ""
        fewer = views // 2
        return f"{fewer}: as many pairs, the volume smoothed {views / fewer:.2g} times as often"

    def ask(self, known: Known, lab: Lab) -> Answer:
        """From the passes and the number of views."""
        problem, given = lab.problem, lab.settings.passes
        of_scan, wanted = problem.geometry.views, lab.settings.views_per_step
        if wanted:
            return Answer(min(of_scan, wanted), "asked for", Status.GIVEN)
        most = _MOST_VIEWS_PLANAR if problem.planar else MOST_VIEWS[lab.device.type]
        # By the root of its passes a longer run makes more steps and larger ones, a shorter one fewer and smaller ones.
        steps = (
            _STEPS_PLANAR
            if problem.planar
            else _STEPS * math.sqrt((given or usual_passes(problem)) / _PASSES)
        )
        if not given and times_of_few_views(problem) == 1:
            steps *= longer(lab.support, known[SeedSpacing], problem)
        together = max(1, min(of_scan, most, round(known[Passes] * of_scan / steps)))
        why = f"of {of_scan}, for about {steps:.0f} steps, and at most {most} views in each"
        return Answer(together, why, Status.ASKED)
