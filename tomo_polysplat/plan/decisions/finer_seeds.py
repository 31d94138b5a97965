"""Which share of the Gaussians is seeded twice as closely as the rest."""

from __future__ import annotations

from typing import Any

from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known, is_number
from tomo_polysplat.plan.decisions.seed_spacing import SeedSpacing
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.settings import Settings

__all__ = ["FinerSeeds"]


class FinerSeeds(Decision):
    """Which share of the seeds lies twice as close as the rest?

    See ``model.seed``.
    """

    name = "finer_seeds"
    needs = (SeedSpacing,)

    def given(self, settings: Settings) -> Any | None:
        """The setting is the share where there are few; whether they are is told by their distance."""
        return None

    def valid(self, value: object) -> bool:
        """A number."""
        return is_number(value)

    def ask(self, known: Known, lab: Lab) -> Answer:
        """Where Gaussians are fewer than the detector could tell apart."""
        if known.answer(SeedSpacing).evidence.get("crowded"):
            return Answer(
                lab.settings.finer_seeds, "Gaussians are few for what the detector tells apart", Status.ASKED
            )
        return Answer(0.0, "all lie as close as the detector tells apart", Status.ASKED)
