"""The answers to what a scene needs, by the name of the decision, with the facts found on the way."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from tomo_polysplat.plan.answer import Answer
from tomo_polysplat.settings import Settings

__all__ = ["Plan", "adapted_to"]

# In dense matter, metal is at least this many times as dense: steel in aluminium, pyrite in quartz.
_METAL = 3.0


@dataclass
class Plan:
    """Answers and facts; the properties give the values that the model is built of.

    Attributes
    ----------
    answers : dict of str to Answer
        In the order in which the questions were asked.
    facts : dict of str to Answer
        What is no choice.
    """

    answers: dict[str, Answer] = field(default_factory=dict)
    facts: dict[str, Answer] = field(default_factory=dict)

    def value(self, name: str, undecided: Any = None) -> Any:
        """The value of an answer; ``undecided`` where there is none yet."""
        return self.answers[name].value if name in self.answers else undecided

    def note(self, name: str, value: Any, why: str = "") -> None:
        """Keep a fact."""
        self.facts[name] = Answer.found(value, why)

    def assuming(self, **values: Any) -> Plan:
        """A plan of its own with other values of some answers."""
        other = Plan(dict(self.answers), dict(self.facts))
        for name, value in values.items():
            other.answers[name] = Answer.found(value)
        return other

    def told(self) -> dict[str, Answer]:
        """Answers and facts together, for `Result.plan`."""
        return copy.copy(self.answers) | self.facts

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        parts = (("answers", self.answers), ("facts", self.facts))
        return {kind: {name: one.to_dict() for name, one in those.items()} for kind, those in parts}

    @classmethod
    def from_dict(cls, parts: Mapping[str, Any]) -> Plan:
        """The plan of `to_dict`; raises TypeError or KeyError for anything else."""
        kinds = ("answers", "facts")
        if unknown := sorted(set(parts) - set(kinds)):
            raise TypeError(f"a plan of answers and facts, got {', '.join(unknown)} as well"[:200])
        return cls(*({name: Answer.from_dict(one) for name, one in parts[kind].items()} for kind in kinds))

    @property
    def reference(self) -> float:
        """Soft reference in g/cm3, or 1/unit when monochromatic."""
        return self.answers["soft_reference"].value["value"]

    @property
    def first(self) -> float:
        """That of the first material."""
        return self.answers["soft_reference"].value["first"]

    @property
    def soft_u(self) -> float:
        """Material number of what the soft reference is."""
        return self.answers["soft_reference"].value["number"]

    @property
    def depth(self) -> float:
        """-log(I/I0) of a typical ray through the soft matter."""
        return self.answers["optical_depth"].value

    @property
    def support_level(self) -> float:
        """What the start holds less of, in soft references, is empty."""
        return self.answers["support_level"].value

    @property
    def spacing(self) -> float:
        """Distance of the seeds in voxels."""
        return self.value("closer_seeds") or self.answers["seed_spacing"].value

    @property
    def finer(self) -> float:
        """Share of the Gaussians that is seeded twice as finely as the rest."""
        return self.answers["finer_seeds"].value

    @property
    def smallest_scale(self) -> float:
        """Smallest deviation of a Gaussian, in voxels, or in spacings where these are closer."""
        return self.answers["smallest_scale"].value

    @property
    def views_per_step(self) -> int:
        """Views of a step of the optimiser."""
        return self.answers["views_per_step"].value

    @property
    def passes(self) -> float:
        """Times that every view is used."""
        return self.answers["passes"].value

    @property
    def tv_every(self) -> int:
        """In every how many steps the volume's total variation is taken."""
        return self.answers["tv_every"].value

    @property
    def tv_corners(self) -> tuple[float, float]:
        """Difference of neighbouring voxels that counts in full: of soft matter, and of dense matter."""
        soft, dense = self.answers["tv_corner"].value
        return soft, dense

    @property
    def curves(self) -> int:
        """Material curves of the model: three, or the first alone."""
        return self.answers["curves"].value

    @property
    def blurred(self) -> bool:
        """Whether rays are seen through the detector's blur."""
        return self.answers["detector_blur"].value

    @property
    def metal(self) -> bool:
        """Whether the start holds metal; True where nobody looked."""
        return bool(self.answers["detector_blur"].evidence.get("metal", 1.0))

    @property
    def pixel_rays(self) -> int:
        """Rays a pixel and axis over which the light is averaged; 0 until that is decided."""
        return self.value("pixel_rays", 0)

    @property
    def fat(self) -> bool | None:
        """Whether light soft matter is fat; None until that is decided."""
        light = self.value("light")
        return None if light is None else light == "fat"

    @property
    def sharp(self) -> bool:
        """Whether seeds are thin across edges however close they are."""
        return self.value("edges") == "sharp"

    @property
    def growth(self) -> float:
        """Largest number of Gaussians at the end, as a multiple of the number of seeds."""
        return self.value("growth", 1.0)

    @property
    def tv_factor(self) -> float:
        """What the settings' weight of the total variation is multiplied by."""
        return self.value("tv_factor", 1.0)

    def with_agent(self, settings: Settings) -> Settings:
        """The settings with what the search for a contrast agent has changed: what is dense is the agent."""
        changes = self.value("agent", {})
        return replace(settings, **changes) if changes else settings

    def adapted(self, settings: Settings) -> Settings:
        """The settings for this object: levels, material numbers, and how much is smoothed."""
        settings = adapted_to(self.answers["soft_reference"].value, settings)
        weight = self.tv_factor * settings.tv_weight
        return replace(settings, tv_weight=weight, support_level=self.support_level, growth=self.growth)


def adapted_to(reference: Mapping[str, float], settings: Settings) -> Settings:
    """The settings with levels and material numbers of what an object is made of.

    Parameters
    ----------
    reference : mapping
        ``value`` and ``first``, the soft reference and that of the first material, its material ``number``, and how
        many references ``dense`` matter has that holds soft matter and is no metal (0: there is none).
    settings : Settings
    """
    value, first, number, dense = (reference[part] for part in ("value", "first", "number", "dense"))
    if value == first:
        metal = max(settings.metal_level, _METAL * dense)
        return replace(settings, metal_level=metal) if dense else settings
    metal = max(settings.metal_level * first / value, min(settings.metal_level, _METAL))
    bone_u, metal_u = max(settings.bone_u, number), max(settings.metal_u, number)
    return replace(settings, metal_level=metal, soft_u=number, bone_u=bone_u, metal_u=metal_u)
