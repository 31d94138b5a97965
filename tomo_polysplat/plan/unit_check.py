"""Densities that no matter has, of a wrong unit of length or size of a pixel, or of the wrong materials."""

from __future__ import annotations

import logging

import numpy as np

from tomo_polysplat.plan.answer import Answer

__all__ = ["doubt_lengths", "tell_impossible"]

logger = logging.getLogger(__name__)

# Osmium's, in g/cm3, and the voxels that a piece has which is more than one that is too high by chance.
_DENSEST_SOLID, _FEWEST = 22.6, 8
# Single voxels of steel overshoot: what is impossible must be this share of all that is metal, denser than titanium.
_OF_METAL, _METAL = 0.2, 5.0
# Share of rays without a value from which these explain it first.
_LIGHTLESS = 0.005
_WRONG_LENGTHS = "The unit of length or the size of a pixel looks wrong"


def doubt_lengths(facts: dict[str, Answer], words: str, what: str = _WRONG_LENGTHS) -> None:
    """Say, once a reconstruction, in the log and as ``facts["lengths"]`` why lengths look wrong."""
    if "lengths" not in facts:
        facts["lengths"] = Answer.found("doubtful", words)
        logger.warning("%s: %s.", what, words)


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
    voxels, metal, densest = 0, 0, 0.0
    for z in range(curves.shape[1]):  # The sum of whole curves would take another volume of memory.
        density = curves[:, z].sum(axis=0)
        voxels += int(np.count_nonzero(density > _DENSEST_SOLID))
        metal += int(np.count_nonzero(density > _METAL))
        densest = max(densest, float(density.max(initial=0.0)))
    if voxels >= max(_FEWEST, _OF_METAL * metal):
        words = f"{voxels} voxels have more than {_DENSEST_SOLID:g} g/cm3, up to {densest:.3g}, which no solid has"
        remedy = (
            "name in materials= what is heavier than their densest or has an absorption edge in the spectrum"
        )
        what = f"{_WRONG_LENGTHS}, or what the metal is"
        if lightless > _LIGHTLESS:
            words += f"; {lightless:.1%} of the rays are opaque or have no value, and tell no density"
            what = "The density of metal is not told by the rays, or the unit of length is wrong"
        doubt_lengths(facts, f"{words}; {remedy}", what)
