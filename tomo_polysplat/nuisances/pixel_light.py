"""Pixels that average the light over their area, as a nuisance (`physics.pixel_light`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tomo_polysplat.nuisances.nuisance import Found, Nuisance, Parameter, Place, Verdict

__all__ = ["PixelLight"]

# Light is averaged where that leaves as much of the misfit of the rays at metal: a fit makes up for most of what it
# does not model. 40 scans of several rays a pixel came to 0.75 to 1.15, six of thin or opaque metal to 1.16 to 1.55;
# 24 of one ray to 1.32 and more, but for grains smaller than a voxel, 1.06, for rods in the middle of a disc, which all
# views see alike, 0.34 to 0.99, and for detail everywhere, 1.02 to 1.18 (docs/decisions/pixel_rays.md).
_AS_WELL = (0.7, 1.2)


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
        """By the ``share`` of the misfit of the rays at metal that averaged light leaves."""
        share = evidence["share"]
        kept = _AS_WELL[0] <= share <= _AS_WELL[1]
        kind = "the light of each pixel is averaged" if kept else "rays are infinitely thin"
        words = f"averaged light leaves {share:.2f} of the misfit of the rays at metal, and is taken from"
        return Verdict(kept, f"{kind}; {words} {_AS_WELL[0]:g} to {_AS_WELL[1]:g}")

    @classmethod
    def margin(cls, share: float) -> float:
        """By how much the ``share`` would have to be another one for the other answer."""
        return min(abs(share - end) for end in _AS_WELL)

    @classmethod
    def told(cls, values: Mapping[str, Any]) -> str:
        """That they do."""
        return "pixels that average the light" if values.get("pixel_rays", 1) > 1 else ""
