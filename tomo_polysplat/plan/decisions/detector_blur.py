"""Whether rays are seen through the detector's blur."""

from __future__ import annotations

from typing import Any

from tomo_polysplat.nuisances.detector_blur import BlurOfDetector
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known
from tomo_polysplat.plan.decisions.passes import Passes
from tomo_polysplat.plan.decisions.soft_reference import SoftReference
from tomo_polysplat.plan.edge_rise import edge_rise
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.settings import Settings

__all__ = ["DetectorBlur"]


class DetectorBlur(Decision):
    """Are rays seen through a blur of the detector?

    Where the blur is to be fitted, edges must be sharp, as those of metal are; see `nuisances.detector_blur`.
    """

    name = "detector_blur"
    needs = (Passes, SoftReference)

    def given(self, settings: Settings) -> Any | None:
        """The settings say how much it is and whether it is fitted; see `ask`."""
        return None

    def valid(self, value: object) -> bool:
        """Yes or no."""
        return isinstance(value, bool)

    def ask(self, known: Known, lab: Lab) -> Answer:
        """Where the start has metal, or other sharp edges."""
        settings = lab.settings
        if not settings.learning_rate_blur:
            words = BlurOfDetector.describe(settings.blur, fitted=False)
            return Answer(settings.blur > 0, words, Status.GIVEN)
        soft = known[SoftReference]["first"] * lab.problem.depth
        metal = bool((lab.start > settings.metal_level * soft).any())
        evidence = {"metal": float(metal), "rise": 0.0 if metal else edge_rise(lab.relative)}
        verdict = BlurOfDetector.gate(evidence | {"blur": settings.blur, "passes": known[Passes]})
        return Answer(verdict.kept, verdict.why, Status.ASKED, evidence)
