"""How much light the soft matter takes away from a typical ray."""

from __future__ import annotations

from typing import Any

from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known, is_number
from tomo_polysplat.plan.decisions.soft_reference import SoftReference
from tomo_polysplat.plan.decisions.support_level import SupportLevel
from tomo_polysplat.plan.depth import optical_depth
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.settings import Settings

__all__ = ["OpticalDepth"]


class OpticalDepth(Decision):
    """How much light does soft matter take from a typical ray?

    -log(I/I0), as if nothing were denser than the soft reference; see `plan.depth`.
    """

    name = "optical_depth"
    needs = (SoftReference, SupportLevel)

    def given(self, settings: Settings) -> Any | None:
        """It is told by the data alone."""
        return None

    def valid(self, value: object) -> bool:
        """A number."""
        return is_number(value)

    def ask(self, known: Known, lab: Lab) -> Answer:
        """From the start volume."""
        reference = known[SoftReference]["value"]
        depth = optical_depth(lab.relative, known[SupportLevel], reference, lab.problem)
        return Answer(depth, "-log(I/I0) of a typical ray through soft matter", Status.ASKED)
