"""What starts as the dense material where one was named: metal, or the pieces that are a contrast agent.

The curve of iodine or barium has an edge that those of bone and of the other metals lack. A mixture of the curves
that holds some of it looks like none of them, and a material number that starts in between does not find its way
to either end: between them the rays fit worse. Nor does the level tell, as a solution is as dense as one likes. So
pieces start as the agent itself or as soft matter, those above a level and those below it, and short fits say
which level fits the rays.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import ndimage

from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.edges import edge_inside
from tomo_polysplat.physics.materials import composition
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known, When, is_number
from tomo_polysplat.plan.decisions.soft_reference import SoftReference
from tomo_polysplat.plan.lab import Lab, Untold
from tomo_polysplat.plan.trial import TOO_SHORT
from tomo_polysplat.settings import Settings

__all__ = ["Agent", "levels_between"]

logger = logging.getLogger(__name__)

# Between that many levels of the start, those farthest apart, the pieces are divided in turn.
_DIVISIONS = 2
# Steps of a short fit. A start nearer to what the rays say fits better at first (iodine, 120 steps: 0.0145 against the
# agent's 0.0148); from here on the physics tells (0.0091 against 0.0076).
_STEPS = 240


class Agent(Decision):
    """What does a dense material that was named start as?

    A dict of the settings that change for the seeds.
    """

    name = "agent"
    needs = (SoftReference,)
    when = When.TRIAL

    def valid(self, value: Any) -> bool:
        """Names and numbers."""
        return isinstance(value, dict) and all(is_number(number) for number in value.values())

    def usual(self, known: Known, lab: Lab) -> dict[str, float]:
        """None changes."""
        return {}

    def why_not(self, known: Known, lab: Lab) -> str:
        """Why no agent is looked for, if so."""
        problem = lab.problem
        # The defaults are not named for an agent: iron has its edge at 7 keV, which only a very soft beam holds.
        if problem.spectrum is None or problem.materials in (None, Materials()):
            return "no dense material was named"
        return ""

    def ask(self, known: Known, lab: Lab) -> Answer:
        """Short fits say above which level pieces are the agent."""
        problem, settings = lab.problem, lab.settings
        assert problem.materials is not None and problem.spectrum is not None
        edge = edge_inside(problem.materials.dense, problem.spectrum)
        if edge is None:
            return _metal_as_named(settings, problem.materials)
        relative = lab.start / (problem.depth * known[SoftReference]["first"])
        levels = levels_between(relative.cpu().numpy(), settings.bone_level)
        if not levels:
            why = (
                f"not looked for: nothing of the start is denser than {settings.bone_level:g} soft references"
            )
            logger.warning(
                "The contrast agent that was named is %s. If it is a weak solution, settings={'bone_level': ...} with a"
                " level between that of soft matter, 1, and its own frees its material number.",
                why,
            )
            return Answer({}, why, Status.USUAL)
        changes: list[dict[str, float]] = [{}] + [
            {"bone_u": 0.0, "metal_u": 1.0, "metal_level": level, "metal_rim": settings.bone_level}
            for level in levels
        ]
        misfits = [_misfit_of(change, lab) for change in changes]
        words = ["as without an edge", *(f"the agent above {level:.3g} soft references" for level in levels)]
        tried = ", ".join(f"{misfit:.4g} {word}" for misfit, word in zip(misfits, words))
        why = f"the dense material has an edge at {edge:.1f} keV; misfit of short fits: {tried}"
        logger.info("Contrast agent: %s", why)
        return Answer(changes[int(np.argmin(misfits))], why, Status.ASKED, dict(zip(words, misfits)))


def _misfit_of(change: dict[str, float], lab: Lab) -> float:
    """Misfit that a short fit with these settings leaves."""
    # Judged by the fitted rays, as few are held out, with as many parameters each time: the level of metal, which
    # differs, would otherwise decide on the blur as well.
    alike: dict[str, Any] = {"held_out": 0.0, "blur": 0.0, "learning_rate_blur": 0.0}
    assert lab.short_fit is not None
    one = lab.short_fit(lab, replace(lab.settings, **(change | alike)), _STEPS)
    if one.cut:
        raise Untold(f"as without an edge: {TOO_SHORT}")
    return one.held_out


def _metal_as_named(settings: Settings, materials: Materials) -> Answer:
    """Metal that was named starts as itself, since its number stays near its start (titanium: 0.87 from 0.8)."""
    default = Materials().dense
    if composition(materials.dense) == composition(default) or settings.metal_u != Settings().metal_u:
        return Answer({}, "the dense material has no edge in the spectrum", Status.USUAL)
    return Answer({"metal_u": 1.0}, "metal starts as the dense material, which was named", Status.USUAL)


def _top(values: np.ndarray) -> float:
    return float(np.quantile(values, 0.9))


def levels_between(start: np.ndarray, bone_level: float) -> list[float]:
    """Levels of a start volume, in soft references, above which its pieces may be the agent.

    They lie in the widest gaps between the pieces: the middle material was named, too, and is taken to be there
    and to be less dense. Bone would be fitted by an agent at all levels better than by soft matter, as it is
    neither. A piece alone is the agent from ``bone_level`` on.
    """
    labels, number = ndimage.label(start > bone_level)
    if number < 2:
        return [bone_level] * number
    # One look at the volume for all of them: noise can make thousands.
    tops = np.sort(ndimage.labeled_comprehension(start, labels, np.arange(1, number + 1), _top, float, 0.0))
    widest = np.argsort(np.diff(tops))[::-1][:_DIVISIONS]
    return [float(0.5 * (tops[k] + tops[k + 1])) for k in sorted(widest)]
