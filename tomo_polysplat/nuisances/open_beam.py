"""A beam of another brightness than its open field: beside the object a brighter one looks like scatter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tomo_polysplat.nuisances.light_gate import light_gate
from tomo_polysplat.nuisances.nuisance import Found, Nuisance, Parameter, Place, Verdict

__all__ = ["LEAST_BRIGHTER", "OpenBeam"]

# A beam that is brighter by less is left as it is.
LEAST_BRIGHTER = 2e-3


class OpenBeam(Nuisance):
    """The brightness of the beam, in those of its open field."""

    name = "beam"
    place = Place.LIGHT
    parameters = {"beam": Parameter("open fields", 1.0, 0.5, 2.0)}
    found_by = Found.RESIDUALS
    gauge = "scatter, which adds to dark rays as well: each is asked whether it explains the rays better"
    cost = "none where rays beside the object tell; one short fit where it may be scatter"

    @classmethod
    def gate(cls, evidence: Mapping[str, float]) -> Verdict:
        """The held-out rays fit 3 % better than without and the darkest no worse, and better than scatter explains."""
        return light_gate(evidence, rival="scatter", darkest_margin=True)

    @classmethod
    def told(cls, values: Mapping[str, Any]) -> str:
        """Its brightness."""
        beam = float(values.get("beam", 1.0))
        return "" if beam == 1.0 else cls.describe(values)

    @classmethod
    def describe(cls, values: Mapping[str, Any]) -> str:
        """In words."""
        return f"a beam {values['beam']:.4g} times as bright as the open field"
