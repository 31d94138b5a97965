"""How thin a Gaussian may become."""

from __future__ import annotations

from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known
from tomo_polysplat.plan.decisions.seed_spacing import SeedSpacing
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.resolution import finest_spacing

__all__ = ["SmallestScale"]

# Smallest deviation of a Gaussian in voxels. Where a volume has fewer Gaussians than the detector could tell apart,
# each shows more of an edge: half as thick (H200, six scenes of 128^3 to 256^3) 0.8 dB more everywhere in the mean,
# 0.05 without metal. Where they are many (40^3), and in slices, that changed nothing or lost 0.1 dB.
_SMALLEST, _SMALLEST_OF_FEW = 0.2, 0.1


class SmallestScale(Decision):
    """How thin may a Gaussian become?

    Its smallest standard deviation in voxels, or in spacings of the seeds where these are closer.
    """

    name = "smallest_scale"
    needs = (SeedSpacing,)

    def ask(self, known: Known, lab: Lab) -> Answer:
        """Thinner where Gaussians are few."""
        if lab.problem.planar or known[SeedSpacing] <= finest_spacing(lab.problem)[0]:
            return Answer(_SMALLEST, "Gaussians are many enough to show edges together", Status.ASKED)
        return Answer(_SMALLEST_OF_FEW, "as Gaussians are few, each shows more of an edge", Status.ASKED)
