"""Pixels that average the light over their area, as a nuisance (`physics.pixel_light`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tomo_polysplat.nuisances.nuisance import Found, Nuisance, Parameter, Place, Verdict

__all__ = ["PixelLight"]

# Light is averaged where that leaves at most so much of the misfit of the rays that it changes: a fit makes up for most
# of what it does not model (docs/decisions/pixel_rays.md).
_AS_WELL = 1.37


class PixelLight(Nuisance):
    """The rays along an axis of each pixel whose light is averaged."""

    name = "pixel_rays"
    place = Place.DETECTOR
    parameters = {"pixel_rays": Parameter("rays a pixel and axis", 1.0, 1.0, 16.0)}
    found_by = Found.BOTH_WAYS
    gauge = (
        "edges of metal, which a fit moves to make up for either: they are told apart by what is left there"
    )
    cost = "some passes of the run are made a second time, each up to four times as long"

    @classmethod
    def gate(cls, evidence: Mapping[str, float]) -> Verdict:
        """By the ``share`` that averaged light leaves of the misfit of the rays that it changes."""
        share = evidence["share"]
        kept = share <= _AS_WELL
        kind = "the light of each pixel is averaged" if kept else "rays are infinitely thin"
        words = (
            f"averaged light leaves {share:.2f} of the misfit of the rays that it changes, and is taken up to"
        )
        return Verdict(kept, f"{kind}; {words} {_AS_WELL:g}")

    @classmethod
    def margin(cls, share: float) -> float:
        """By how much the ``share`` would have to be another one for the other answer."""
        return abs(share - _AS_WELL)

    @classmethod
    def told(cls, values: Mapping[str, Any]) -> str:
        """That they do."""
        return "pixels that average the light" if values.get("pixel_rays", 1) > 1 else ""
