"""Below which level the start is empty."""

from __future__ import annotations

import math
from typing import Any

from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known, is_number
from tomo_polysplat.plan.decisions.soft_reference import SoftReference, lightness
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.plan import adapted_to
from tomo_polysplat.settings import Settings

__all__ = ["SupportLevel"]

# Where the main matter is lighter than this, in soft references, as in foam or down, the level of nothing is lowered.
_LIGHT = 0.15


class SupportLevel(Decision):
    """Below which level is the start empty?

    In soft references. The evidence tells how light the main matter is.
    """

    name = "support_level"
    needs = (SoftReference,)

    def given(self, settings: Settings) -> Any | None:
        """The setting is the level of usual matter, which is lowered alike for foam and down."""
        return None

    def valid(self, value: object) -> bool:
        """A number."""
        return is_number(value)

    def alternative(self, lab: Lab) -> str:
        """Seeds everywhere."""
        dims, grid = lab.problem.dimensions, lab.problem.grid
        everywhere = math.prod((grid.extent / lab.problem.voxel)[:dims]) / lab.plan.spacing**dims
        return f"0: up to {everywhere:.3g} Gaussians for {len(lab.seeds())}, the empty space with them"

    def ask(self, known: Known, lab: Lab) -> Answer:
        """From how light the main matter is."""
        light = lightness(lab.relative, adapted_to(known[SoftReference], lab.settings).metal_level)
        level = lab.settings.support_level * min(1.0, light / _LIGHT)
        least = level * known[SoftReference]["value"] * lab.problem.depth
        voxels = int((lab.start > least).sum())
        why = f"{voxels} of {lab.relative.numel()} voxels hold more than {level:.2g} soft references"
        return Answer(level, why, Status.ASKED, {"lightness": light, "voxels": voxels})
