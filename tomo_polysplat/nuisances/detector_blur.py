"""The blur of the detector as a nuisance (`physics.detector_blur`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tomo_polysplat.nuisances.nuisance import Found, Nuisance, Parameter, Place, Verdict
from tomo_polysplat.physics.detector_blur import LARGEST_BLUR

__all__ = ["BlurOfDetector"]


# Share of their height that edges rise from one voxel to the next, from which on they hold the blur: those of a step
# that is blurred by 1.2 voxels at most. Blobs of 3 voxels' deviation and more come to 0.24, with noise to 0.29, and
# starts of objects with sharp edges, 28^3 and from a detector that blurs by 0.57 pixels, to 0.38 to 0.60.
_RISE = 1 / 3
# In shorter runs Gaussians stay rough, and a blur makes up for that: discs of 49^2 before sharp pixels come to a
# variance of 0.26 in five passes, and to 0.12 in twenty.
_FEWEST_PASSES = 10.0


class BlurOfDetector(Nuisance):
    """One blur of the projections, alike along rows and columns."""

    name = "detector_blur"
    place = Place.DETECTOR
    parameters = {"blur": Parameter("squared pixels", 0.0, 0.0, LARGEST_BLUR)}
    found_by = Found.GRADIENT
    gauge = (
        "a smooth object: sharp edges, as those of metal, hold the blur; without them it stays at its start"
    )
    cost = "next to nothing: its gradient comes with that of the rays"

    @classmethod
    def gate(cls, evidence: Mapping[str, float]) -> Verdict:
        """Whether edges of the start volume hold it, from the variance ``blur`` on.

        It holds ``metal`` (1, or 0), or else its edges ``rise`` from voxel to voxel by so much of their height, in a
        run of so many ``passes``.
        """
        words = f"fitted, from a variance of {evidence['blur']:g} squared pixels on"
        if evidence["metal"] > 0:
            return Verdict(True, f"{words}: metal has edges that hold it")
        rises = f"edges rise by {evidence['rise']:.2f} of their height from voxel to voxel"
        if evidence["rise"] >= _RISE and evidence["passes"] >= _FEWEST_PASSES:
            return Verdict(True, f"{words}: {rises}, and hold it")
        if evidence["rise"] >= _RISE:
            return Verdict(
                False, "none: without metal, in so few passes a blur would make up for rough Gaussians"
            )
        why = f"without metal, a smooth object and a detector that blurs look alike ({rises})"
        return Verdict(False, f"none: {why}")

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
