"""What a result's plan says, for people: the only file of the report that reads ``Result.plan``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tomo_polysplat.nuisances.known import NUISANCES
from tomo_polysplat.plan.answer import Answer, Status

__all__ = [
    "RayPhysics",
    "decisions",
    "doubts",
    "found_about_the_scanner",
    "how_it_ended",
    "how_rays_are_missed",
    "in_words",
    "ray_physics",
    "rest_of_plan",
]


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
    "rays": "How the rays are missed, in times their noise",
    "returned": "What is returned",
    "spectrum": "The spectrum",
    "spectrum_doubt": "Whether the spectrum fits",
    "water_correction": "The scanner's water correction",
    "filter_map": "The filter in front of each pixel",
    "bowtie": "The bowtie filter",
    "mended": "What was mended",
    "alignment": "The scanner's geometry",
    "scatter": "Scatter",
    "detector_blur": "The detector's blur",
    "fitted_blur": "The blur that was found",
    "pixel_rays": "Rays a pixel and axis",
    "beam": "The beam, in open fields",
    "gains": "Gains of the pixels, rms of their logarithm",
    "drift": "The source's light from view to view, rms of its logarithm",
    "photons_per_ray": "The noise (photons of an open ray)",
    "hardening": "Beam hardening (the largest -log(I/I0))",
    "curves": "Material curves",
    "soft_reference": "The object's main matter",
    "soft_material": "The material number of soft matter",
    "light": "Less dense soft matter",
    "start": "The start",
    "unseen": "The share of the volume that no ray sees",
    "window": "The edge of the volume",
    "edges": "Edges",
    "growth": "The number of Gaussians, in those of the seeds",
    "tv_factor": "Smoothing, in times the usual",
    "passes": "Passes over the views",
    "seeds_in_time": "Gaussians that the time budget has room for",
    "time_budget": "The time budget, as a share of the run",
    "compiling": "Compiling, in seconds",
    "stop": "The end",
}


def decisions(plan: Mapping[str, Answer]) -> list[tuple[str, Answer]]:
    """Subject and answer of all that a reader asks for, in that order."""
    return [(_TOLD[name], plan[name]) for name in _TOLD if name in plan]


def in_words(answer: Answer) -> str:
    """Its value, if that is short, and why."""
    value = answer.value
    if isinstance(value, (Mapping, list, tuple)) or value == "":
        return answer.why
    return str(answer)


def found_about_the_scanner(plan: Mapping[str, Answer]) -> str:
    """One sentence on what the fit took from the rays about how they were measured."""
    values = _of_nuisances(plan)
    found = [words for kind in NUISANCES if (words := kind.told(values))]
    # Before what was fitted comes what was known or mended.
    for name, what in (
        ("filter_map", "a filter in front of each pixel"),
        ("water_correction", "a water correction, undone"),
        ("mended", "an axis that was off"),
    ):
        if name in plan:
            found.insert(0, f"{what} ({plan[name].why})")
    if not found:
        return "The rays show the scanner as the geometry and the spectrum tell it."
    return f"About the scanner was found: {'; '.join(found)}."


def _of_nuisances(plan: Mapping[str, Answer]) -> dict[str, Any]:
    """Parameters of nuisances by name, as far as the rays have told them."""
    values = dict(plan["alignment"].value) if "alignment" in plan else {}
    values |= plan["calibration"].value["fitted"] if "calibration" in plan else {}
    if "fitted_blur" in plan and plan["detector_blur"].status is Status.ASKED:
        values["blur"] = plan["fitted_blur"].value
    values |= {name: plan[name].value for name in ("bowtie", "gains", "drift") if name in plan}
    values |= {"beam": beam} if (beam := _beam(plan)) != 1.0 else {}
    values |= {"beside": plan["drift"].evidence.get("beside", 1.0)} if "drift" in plan else {}
    return values | ({"pixel_rays": plan["pixel_rays"].value} if "pixel_rays" in plan else {})


def _beam(plan: Mapping[str, Answer]) -> float:
    """The brightness of the beam: what was taken out before the run, and what was fitted in it."""
    fitted = plan["calibration"].value["fitted"] if "calibration" in plan else {}
    return float(fitted.get("beam", 1.0)) * (float(plan["beam"].value) if "beam" in plan else 1.0)


def how_it_ended(plan: Mapping[str, Answer]) -> str:
    """Why the run ended."""
    return plan["stop"].why if "stop" in plan else ""


def how_rays_are_missed(plan: Mapping[str, Answer]) -> str:
    """What the run itself found about the rays that it had not seen; empty where it found nothing."""
    return f"The {plan['rays'].why}." if "rays" in plan else ""


def doubts(plan: Mapping[str, Answer]) -> list[str]:
    """What the run itself says is to be distrusted."""
    found = []
    if "object" in plan:
        found.append(f"that there is an object ({plan['object'].why})")
    if "alignment" in plan and plan["alignment"].evidence.get("turned"):
        turned = plan["alignment"].evidence["turned"]
        found.append(f"all of it (opposite rays agree {turned:.1f} times better with the angles times -1)")
    if "returned" in plan:
        found.append(f"whatever is finer than a filtered backprojection shows ({plan['returned'].why})")
    elif "rays" in plan and plan["rays"].evidence.get("far"):
        found.append(f"all of it, for the {plan['rays'].why}")
    if "spectrum_doubt" in plan:
        found.append(f"the spectrum ({plan['spectrum_doubt'].why})")
    if "lengths" in plan:
        found.append(f"the unit of length, and every density with it ({plan['lengths'].why})")
    return found


def rest_of_plan(plan: Mapping[str, Answer]) -> dict[str, Any]:
    """The entries that `decisions` leaves out."""
    return {
        name: answer.value if isinstance(answer.value, Mapping) and not answer.why else in_words(answer)
        for name, answer in plan.items()
        if name not in _TOLD
    }


def ray_physics(plan: Mapping[str, Answer]) -> RayPhysics:
    """The numbers of the plan that a prediction of the rays needs."""
    found = plan["calibration"].value["fitted"] if "calibration" in plan else {}
    return RayPhysics(
        blur=float(plan["fitted_blur"].value) if "fitted_blur" in plan else 0.0,
        pixel_rays=max(1, plan["pixel_rays"].value) if "pixel_rays" in plan else 1,
        scatter=float(found.get("scatter", 0.0)),
        of_light=float(found.get("scatter_of_light", 0.0)),
        beam=_beam(plan),
    )
