"""A bowtie filter, or the anode's heel, as a nuisance: the filter of a pixel is thicker the farther out it is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from tomo_polysplat.nuisances.nuisance import Found, Nuisance, Parameter, Place, Verdict

__all__ = ["Bowtie"]

# In cm of aluminium, as a deviation over the pixels; and in standard errors.
_LEAST, _SURE = 0.01, 4.0
# Held-out rays have to fit so much better, and by so many standard errors.
_BETTER, _SURELY_BETTER = 0.03, 3.0


class Bowtie(Nuisance):
    """Centimetres of aluminium, by powers of the place of a pixel: -1 to 1 along columns (u) and rows (v)."""

    name = "bowtie"
    place = Place.SPECTRUM
    parameters = {
        "u2": Parameter("cm of aluminium at both sides, as the square", 0.0, 0.0, 5.0),
        "u4": Parameter("likewise, as the fourth power", 0.0, 0.0, 5.0),
        "u": Parameter("cm of aluminium from the middle to one side, as a straight line", 0.0, -2.5, 2.5),
        "v": Parameter("likewise along the rows", 0.0, -2.5, 2.5),
    }
    found_by = Found.RESIDUALS
    gauge = (
        "a filter that all pixels have in common is the spectrum's: the thinnest place has none. What a pixel leaves in"
        " all views alike is a gain or a ring of the object"
    )
    cost = "residuals of some rays; where they show one, two fits by joined pixels, and the run begins anew"

    @classmethod
    def suspected(cls, evidence: Mapping[str, float]) -> Verdict:
        """Whether what a run leaves, a ``spread`` in cm and its ``error``, is worth two fits."""
        spread, error = evidence["spread"], evidence["error"]
        words = f"the rays show {spread:.2g} cm of aluminium more or less (standard error {error:.1g})"
        return Verdict(spread > _LEAST + _SURE * error, words)

    @classmethod
    def gate(cls, evidence: Mapping[str, float]) -> Verdict:
        """By what share, ``better``, the misfit of held-out rays falls, and its standard error."""
        better, error = evidence["better"], evidence["better_error"]
        kept = better > max(_BETTER, _SURELY_BETTER * error)
        words = f"the misfit of held-out rays falls by {better:.1%} (standard error {error:.1%})"
        return Verdict(kept and math.isfinite(better), words)

    @classmethod
    def told(cls, values: Mapping[str, Any]) -> str:
        """The coefficients."""
        found = values.get(cls.name) or {}
        parts = [f"{name} {found[name]:+.2g}" for name in cls.parameters if found.get(name)]
        return f"a filter of aluminium in front of the pixels, in cm: {', '.join(parts)}" if parts else ""
