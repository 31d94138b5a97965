"""A bowtie filter as a nuisance: the filter in front of a pixel is thicker the farther out it is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tomo_polysplat.nuisances.nuisance import Found, Nuisance, Parameter, Place, Verdict

__all__ = ["Bowtie"]

# In cm of aluminium at the thickest place. Scans without a bowtie came to 0.12 at most (bone, grains, teeth of 24^3),
# as a fit leaves some cupping; a pepper came to 0.34, and foam is contradicted.
_LEAST = 0.2
# It is taken at its word unless held-out rays contradict it by as much: an object makes up for most of it. Behind
# bowties of 0.3 to 3 cm the misfit fell by -8 to 14 %; of foam without one by -28 %.
_CONTRADICTION = 0.1


class Bowtie(Nuisance):
    """Centimetres of aluminium, by powers of the place of a pixel along columns, -1 to 1 over the detector."""

    name = "bowtie"
    place = Place.SPECTRUM
    parameters = {
        "parabola": Parameter("cm of aluminium at both sides, more than in the middle", 0.0, 0.0, 5.0),
        "slope": Parameter("cm of aluminium at the last column, more than in the middle", 0.0, -2.5, 2.5),
    }
    found_by = Found.RESIDUALS
    gauge = (
        "a filter that all pixels have in common is the spectrum's: the thinnest place has none. What a pixel leaves in"
        " all views alike is a gain or a ring of the object. A bowtie is not thicker in the middle"
    )
    cost = "two fits by joined pixels, where filter_map='fit' asks for it"

    @classmethod
    def gate(cls, evidence: Mapping[str, float]) -> Verdict:
        """Whether the ``thickest`` place is thick enough, in cm, and held-out rays do not contradict.

        ``better`` is the share by which their misfit falls, and ``better_error`` its standard error.
        """
        thickest, better, error = (evidence[name] for name in ("thickest", "better", "better_error"))
        if not thickest > _LEAST:
            return Verdict(False, f"{thickest:.2g} cm of aluminium more at the sides are not told from none")
        words = f"the misfit of held-out rays falls by {better:.1%} (standard error {error:.1%})"
        return Verdict(better > -_CONTRADICTION, words)

    @classmethod
    def told(cls, values: Mapping[str, Any]) -> str:
        """How thick it is."""
        found = values.get(cls.name) or {}
        parts = [f"{name} {found[name]:.2g}" for name in cls.parameters if found.get(name)]
        return f"a bowtie of aluminium in cm, {', '.join(parts)}" if parts else ""
