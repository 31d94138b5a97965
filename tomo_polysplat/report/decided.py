"""What a result's plan says, for people: the only file that reads ``Result.plan``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

__all__ = [
    "Decision",
    "RayPhysics",
    "decisions",
    "found_about_the_scanner",
    "how_it_ended",
    "ray_physics",
    "rest_of_plan",
]


@dataclass(frozen=True)
class Decision:
    """One decision of the plan.

    Attributes
    ----------
    name : str
        As in the plan.
    value : str
        What was chosen, in short; empty where the reason says it.
    why : str
        The evidence in words.
    status : str
        "given", "asked", "usual", "found", or empty where the plan does not say.
    """

    name: str
    value: str
    why: str
    status: str = ""


@dataclass(frozen=True)
class RayPhysics:
    """What the plan found about how rays are measured, beside the spectrum.

    Attributes
    ----------
    blur : float
        Variance of the detector's blur in squared pixels.
    pixel_rays : int
        Rays a pixel and axis over which the light is averaged.
    scatter, of_light : float
        Scattered signal as a fraction of the open beam, and its part that goes with the light around a ray.
    beam : float
        Brightness of the beam, in those of the open field.
    """

    blur: float = 0.0
    pixel_rays: int = 1
    scatter: float = 0.0
    of_light: float = 0.0
    beam: float = 1.0


# What mattered, in the order in which a reader asks; and a sentence's subject for each.
_TOLD = {
    "model": "The rays",
    "spectrum": "The spectrum",
    "water_correction": "The scanner's water correction",
    "calibration": "Calibration",
    "scatter": "Scatter",
    "detector_blur": "The detector's blur",
    "pixel_rays": "The light over a pixel",
    "photons_per_ray": "The noise (photons of an open ray)",
    "hardening": "Beam hardening",
    "curves": "Material curves",
    "soft_reference": "The object's main matter",
    "soft_material": "The material of soft matter",
    "light": "Less dense soft matter",
    "start": "The start",
    "window": "The edge of the volume",
    "edges": "Edges",
    "growth": "The number of Gaussians",
    "smoothing": "Smoothing",
    "passes": "Passes over the views",
    "stop": "The end",
}
# What tells of the scanner in the verdict. An entry that a new nuisance adds to the plan gets its line here.
_SCANNER = {
    "water_correction": "a water correction,",
    "scatter": "scatter,",
    "detector_blur": "the detector's blur,",
    "pixel_rays": "rays a pixel,",
}
_SAYS_NOTHING = ("not asked", "not modelled", "none", "1, infinitely", "1: ")
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def _read(plan: Mapping[str, Any], name: str) -> Decision | None:
    """One entry, whether the plan holds words, a mapping or an answer with attributes."""
    entry = plan.get(name)
    if entry is None:
        return None
    if hasattr(entry, "why"):
        return Decision(name, str(entry.value), str(entry.why), str(getattr(entry, "status", "")))
    if isinstance(entry, Mapping):
        why = entry.get("why", entry.get("reason", ""))
        return Decision(name, str(entry.get("value", "")), str(why), str(entry.get("status", "")))
    value, separator, why = str(entry).partition(": ")
    return Decision(name, value, why) if separator else Decision(name, "", str(entry))


def decisions(plan: Mapping[str, Any]) -> list[tuple[str, Decision]]:
    """Subject and decision of all that a reader asks for, in that order."""
    read = ((name, _read(plan, name)) for name in _TOLD)
    return [(_TOLD[name], one) for name, one in read if one is not None]


def found_about_the_scanner(plan: Mapping[str, Any]) -> str:
    """One sentence on what the fit took from the rays about how they were measured."""
    found = []
    for name, subject in _SCANNER.items():
        one = _read(plan, name)
        words = (
            ""
            if one is None
            else f"{one.value}: {one.why}"
            if one.value and one.why
            else one.value or one.why
        )
        if words and not words.startswith(_SAYS_NOTHING) and not _is_zero(words):
            found.append(f"{subject} {words.partition('; ')[0]}")
    if not found:
        return "About the scanner nothing was found that the geometry and the spectrum had not said."
    return f"About the scanner was found: {'; '.join(found)}."


def _is_zero(words: str) -> bool:
    """Whether all that it says is that something is nought."""
    number = _NUMBER.search(words)
    return number is not None and float(number.group()) == 0


def how_it_ended(plan: Mapping[str, Any]) -> str:
    """Why the run ended."""
    one = _read(plan, "stop")
    return "" if one is None else f"{one.value}: {one.why}" if one.value and one.why else one.value or one.why


def rest_of_plan(plan: Mapping[str, Any]) -> dict[str, Any]:
    """The entries that `decisions` leaves out, as they are."""
    return {name: _plain(entry) for name, entry in plan.items() if name not in _TOLD}


def _plain(entry: Any) -> Any:
    if hasattr(entry, "why"):
        return f"{entry.value}: {entry.why}"
    return entry


def ray_physics(plan: Mapping[str, Any]) -> RayPhysics:
    """The numbers of the plan that a prediction of the rays needs."""
    entry = plan.get("calibration")
    evidence = getattr(entry, "evidence", entry)
    found = evidence.get("fitted", {}) if isinstance(evidence, Mapping) else {}
    return RayPhysics(
        blur=_number(plan, "detector_blur", 0.0),
        pixel_rays=max(1, int(_number(plan, "pixel_rays", 1.0))),
        scatter=float(found.get("scatter", 0.0)),
        of_light=float(found.get("scatter_of_light", 0.0)),
        beam=float(found.get("beam", 1.0)),
    )


def _number(plan: Mapping[str, Any], name: str, otherwise: float) -> float:
    """The first number of an entry."""
    one = _read(plan, name)
    if one is None:
        return otherwise
    for words in (one.value, one.why):
        if (number := _NUMBER.search(words)) is not None:
            return float(number.group())
    return otherwise
