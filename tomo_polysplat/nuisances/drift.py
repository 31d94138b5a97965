"""A source whose light changes from view to view, as a nuisance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tomo_polysplat.nuisances.light_factor import LightFactor
from tomo_polysplat.nuisances.nuisance import Parameter, Place

__all__ = ["Drift"]

# Of the views, in which rays pass beside the object: these know the source, whatever the object is.
_HALF = 0.5


class Drift(LightFactor):
    """One factor a view."""

    name = "drift"
    place = Place.LIGHT
    parameters = {"drift": Parameter("rms over the views of the log of their light", 0.0, 0.0, 1.0)}
    gauge = "the open beam of all views together: the mean of the logarithms stays 0"
    cost = "none beside that of the gains"

    @classmethod
    def told(cls, values: Mapping[str, Any]) -> str:
        """How much it changes; ``beside`` is the share of views in which rays pass beside the object."""
        drift = float(values.get("drift", 0.0))
        if not drift:
            return ""
        if alike := cls.looks_alike(values):
            return f"light that changes by {drift:.2%} from view to view ({alike})"
        return f"a source whose light changes by {drift:.2%} from view to view"

    @classmethod
    def looks_alike(cls, values: Mapping[str, Any]) -> str:
        """What else it may be, in words; empty where rays beside the object tell."""
        if values.get("beside", 1.0) >= _HALF:
            return ""
        return "no rays beside the object tell a drifting source from matter that the detector does not see"
