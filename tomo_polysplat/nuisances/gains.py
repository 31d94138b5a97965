"""Gains of the detector's pixels as a nuisance: rings in the volume."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tomo_polysplat.nuisances.light_factor import LightFactor
from tomo_polysplat.nuisances.nuisance import Parameter, Place

__all__ = ["Gains"]


class Gains(LightFactor):
    """One log-gain a pixel, the same in all views."""

    name = "gains"
    place = Place.DETECTOR
    parameters = {"gains": Parameter("rms over the pixels of the log of their gain", 0.0, 0.0, 1.0)}
    gauge = (
        "rings in the object, and what neighbouring pixels have in common, which is the object's or the"
        " spectrum's: gains are as strong for short waves across the detector as for long ones"
    )
    cost = "residuals of all rays after three to six passes, each a part of a pass"

    @classmethod
    def told(cls, values: Mapping[str, Any]) -> str:
        """How much they differ."""
        gains = float(values.get("gains", 0.0))
        return f"gains of the pixels that differ by {gains:.2%}" if gains else ""
