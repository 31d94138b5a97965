"""Densities that no matter has, or few do, of a wrong unit of length or size of a pixel, or of the wrong materials."""

from __future__ import annotations

import logging
import math

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.fit.host_rays import HostRays
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.plan.answer import Answer
from tomo_polysplat.units import CM_PER_UNIT, Doubt, density_in_doubt

__all__ = ["doubt_lengths", "lengths_in_doubt", "refuse_lengths", "tell_impossible"]

logger = logging.getLogger(__name__)

# Osmium's, in g/cm3, and the voxels that a piece has which is more than one that is too high by chance.
_DENSEST_SOLID, _FEWEST = 22.6, 8
# Single voxels of steel overshoot: what is impossible must be this share of all that is metal, denser than titanium.
_OF_METAL, _METAL = 0.2, 5.0
# Share of rays without a value from which these explain it first.
_LIGHTLESS = 0.005
# -log(I/I0) of the darker rays from which there is matter that attenuates, and not noise alone.
_ATTENUATES, _DARKER = 0.1, 95.0
_VIEWS = 24
# Of the hardening by a solid of its density, what light matter shows whose density is told ten times too high, if it is
# even: 0.05 to 0.2. Solids show more.
_LIGHT = 0.2
# Light matter has ten times its density where lengths are told ten times too short. If most voxels with matter have
# less than this, in g/cm3, the lengths are right.
_LIGHT_MATTER, _MATTER = 4.0, 0.1
_WRONG_LENGTHS = "The unit of length or the size of a pixel looks wrong"


def doubt_lengths(facts: dict[str, Answer], words: str, what: str = _WRONG_LENGTHS) -> None:
    """Say, once a reconstruction, in the log and as ``facts["lengths"]`` why lengths look wrong."""
    if "lengths" not in facts:
        facts["lengths"] = Answer.found("doubtful", words)
        logger.warning("%s: %s.", what, words)


def lengths_in_doubt(level: float, problem: Problem) -> Doubt | None:
    """Whether the object's main matter has a density that a wrong unit would explain.

    Parameters
    ----------
    level : float
        Attenuation of the main matter in that of water, or of the first material where that is a solid.
    problem : Problem
        Polychromatic.
    """
    if not _attenuates(problem.projections):
        return None
    cm = problem.depth / problem.length
    unit = next((name for name, size in CM_PER_UNIT.items() if math.isclose(size, cm, rel_tol=1e-6)), "cm")
    light = problem.hardening is not None and problem.hardening < _LIGHT
    return density_in_doubt(level, unit, light)


def refuse_lengths(doubt: Doubt) -> Exception:
    """The exception to raise where no matter is like that."""
    remedy = f"{doubt.remedy}; settings={{'density_check': 'warn'}} goes on"
    return fail("unit", "lengths that make possible matter of the object", doubt.words, remedy)


def _attenuates(projections: np.ndarray | HostRays) -> bool:
    """Whether rays lose light, which those through next to nothing do not."""
    some = projections[:: -(-len(projections) // _VIEWS)]
    finite = some[np.isfinite(some)]
    return bool(len(finite)) and float(np.percentile(finite, _DARKER)) > _ATTENUATES


def tell_impossible(curves: np.ndarray, facts: dict[str, Answer], lightless: float = 0.0) -> None:
    """Doubt the lengths, or the materials, of a volume whose metal is denser than any solid.

    Parameters
    ----------
    curves : (3, nz, ny, nx) array
        Densities in g/cm3 of the material curves.
    facts : dict of str to Answer
        The plan's.
    lightless : float
        Share of the rays that are opaque or have no value: metal that no light passes is what they may have met.
    """
    if sum(float(curve.max(initial=0.0)) for curve in curves) <= _DENSEST_SOLID:
        return
    voxels, metal, light, matter, densest = 0, 0, 0, 0, 0.0
    for z in range(curves.shape[1]):  # The sum of whole curves would take another volume of memory.
        density = curves[:, z].sum(axis=0)
        voxels += int(np.count_nonzero(density > _DENSEST_SOLID))
        metal += int(np.count_nonzero(density > _METAL))
        light += int(np.count_nonzero((density > _MATTER) & (density < _LIGHT_MATTER)))
        matter += int(np.count_nonzero(density > _MATTER))
        densest = max(densest, float(density.max(initial=0.0)))
    if voxels >= max(_FEWEST, _OF_METAL * metal):
        words = f"{voxels} voxels have more than {_DENSEST_SOLID:g} g/cm3, up to {densest:.3g}, which no solid has"
        remedy = (
            "name in materials= what is heavier than their densest or has an absorption edge in the spectrum"
        )
        # An absorption edge, as of lead or tin, makes metal alone too dense.
        right = 2 * light > matter
        what = "What the metal is looks wrong" if right else f"{_WRONG_LENGTHS}, or what the metal is"
        if lightless > _LIGHTLESS:
            words += f"; {lightless:.1%} of the rays are opaque or have no value, and tell no density"
            what = "The density of metal is not told by the rays"
            what += "" if right else ", or the unit of length is wrong"
        if right:
            words += "; most other matter is as light as matter is, which speaks for the unit of length"
        doubt_lengths(facts, f"{words}; {remedy}", what)
