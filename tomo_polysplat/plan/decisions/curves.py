"""How many material curves the model mixes."""

from __future__ import annotations

from typing import Any

from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known
from tomo_polysplat.plan.decisions.soft_reference import SoftReference
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.settings import Settings

__all__ = ["Curves"]


class Curves(Decision):
    """How many material curves does the model mix?

    Three, or the first alone.
    """

    name = "curves"
    needs = (SoftReference,)

    def given(self, settings: Settings) -> Any | None:
        """Of one energy there is one whatever was asked for; see `ask`."""
        return None

    def valid(self, value: object) -> bool:
        """One or three."""
        return type(value) is int and value in (1, 3)

    def alternative(self, lab: Lab) -> str:
        """More, or fewer."""
        if not lab.problem.polychromatic:
            return ""
        if lab.plan.curves == 1:
            return "3: three images for one, and the same volume"
        return "1: one image for three, and no metal or bone but as dense soft matter"

    def ask(self, known: Known, lab: Lab) -> Answer:
        """Three where the start has matter so dense that its material number is free."""
        settings = lab.settings
        if not lab.problem.polychromatic:
            why = "there is one energy, and no material to tell by it"
            why += "; light='fat' has no effect" if settings.light == "fat" else ""
            return Answer(1, why, Status.USUAL)
        if settings.curves:
            return Answer(settings.curves, "asked for", Status.GIVEN)
        if settings.soft_u:
            return Answer(3, "soft matter has a material number other than 0", Status.GIVEN)
        if settings.light == "fat":
            return Answer(3, "light matter has a material number of its own", Status.GIVEN)
        soft = known[SoftReference]["first"] * lab.problem.depth
        dense = int((lab.start > settings.bone_level * soft).sum())
        if dense:
            why = f"{dense} voxels of the start are denser than {settings.bone_level:g} soft references"
            return Answer(3, why, Status.ASKED, {"voxels": dense})
        largest = float(lab.start.max()) / soft if soft else 0.0
        why = f"the densest voxel of the start has {largest:.2g} soft references: no material number would be free"
        return Answer(1, why, Status.ASKED, {"largest": largest})
