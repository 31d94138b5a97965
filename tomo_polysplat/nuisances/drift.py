"""A source whose light changes from view to view, as a nuisance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tomo_polysplat.nuisances.light_factor import LightFactor
from tomo_polysplat.nuisances.nuisance import Parameter, Place

__all__ = ["Drift"]


class Drift(LightFactor):
    """One factor a view."""

    name = "drift"
    place = Place.LIGHT
    parameters = {"drift": Parameter("rms over the views of the log of their light", 0.0, 0.0, 1.0)}
    gauge = "the open beam of all views together: the mean of the logarithms stays 0"
    cost = "none beside that of the gains"

    @classmethod
    def told(cls, values: Mapping[str, Any]) -> str:
        """How much it changes."""
        drift = float(values.get("drift", 0.0))
        return f"a source whose light changes by {drift:.2%} from view to view" if drift else ""
