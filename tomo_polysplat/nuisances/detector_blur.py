"""The blur of the detector as a nuisance (`physics.detector_blur`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tomo_polysplat.nuisances.nuisance import Found, Nuisance, Parameter, Place, Verdict
from tomo_polysplat.physics.detector_blur import LARGEST_BLUR

__all__ = ["BlurOfDetector"]


class BlurOfDetector(Nuisance):
    """One blur of the projections, alike along rows and columns."""

    name = "detector_blur"
    place = Place.DETECTOR
    parameters = {"blur": Parameter("squared pixels", 0.0, 0.0, LARGEST_BLUR)}
    found_by = Found.GRADIENT
    gauge = (
        "a smooth object: metal, whose edges are sharp, holds the blur; without metal it stays at its start"
    )
    cost = "next to nothing: its gradient comes with that of the rays"

    @classmethod
    def gate(cls, evidence: Mapping[str, float]) -> Verdict:
        """Whether the start volume holds ``metal`` (1, or 0), from whose edges the variance ``blur`` on is fitted."""
        if evidence["metal"] > 0:
            words = f"fitted, from a variance of {evidence['blur']:g} squared pixels on"
            return Verdict(True, f"{words}: metal has edges that hold it")
        return Verdict(False, "none: without metal, a smooth object and a detector that blurs look alike")

    @classmethod
    def told(cls, values: Mapping[str, Any]) -> str:
        """Its standard deviation."""
        blur = float(values.get("blur", 0.0))
        return f"a detector that blurs by {blur**0.5:.2g} pixels (standard deviation)" if blur else ""

    @classmethod
    def describe(cls, variance: float, *, fitted: bool) -> str:
        """What a reconstruction took for the blur, in words; the ``variance`` in squared pixels."""
        if not (fitted or variance):
            return "none, as asked for: rays are infinitely thin"
        return f"variance of {variance:.3f} squared pixels, {'fitted' if fitted else 'held as asked for'}"
