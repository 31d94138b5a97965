"""Whether pixels average the light over their area, asked of the rays at metal in the middle of a run.

Real pixels do, and simulators that send several rays through each; others send one. Who is wrong about it puts up to
a third too little metal there, or a quarter too much. At first a fit is too rough to tell: later the run is made
both ways for two passes over the rays at metal in some views, and goes on as that explains these rays.
"""

from __future__ import annotations

import copy
import logging

from tomo_polysplat.fit.close_up import close_up
from tomo_polysplat.fit.fork import why_no_fork
from tomo_polysplat.nuisances.pixel_light import PixelLight
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known, When
from tomo_polysplat.plan.decisions.passes import Passes
from tomo_polysplat.plan.first_gaussians import AVERAGED_RAYS, why_one_run
from tomo_polysplat.plan.lab import Lab, Untold

__all__ = ["PixelRays"]

logger = logging.getLogger(__name__)

# Share of the run after which it is asked.
_FROM = 0.4
# Views, views of a step and passes of each way (docs/decisions/pixel_rays.md). One pass tells less than two.
_VIEWS, _OF_A_STEP, _PASSES = 120, 2, 2
# Factor of the time of a step, at most, where light is averaged over two rays a pixel and axis.
_SLOWER = 4.0


class PixelRays(Decision):
    """Do pixels average the light over their area?

    Rays a pixel and axis over which it is averaged; 1: infinitely thin rays.
    """

    name = "pixel_rays"
    needs = (Passes,)
    when = When.DURING
    share = _FROM

    def valid(self, value: object) -> bool:
        """A whole number."""
        return type(value) is int and value > 0

    def usual(self, known: Known, lab: Lab) -> int:
        """Infinitely thin."""
        return 1

    def why_not(self, known: Known, lab: Lab) -> str:
        """Why it is not asked, if so."""
        assert lab.gaussians is not None
        if not lab.problem.polychromatic:
            return "one energy tells no metal from other matter"
        if not bool((lab.gaussians.group > 0).any()):
            return "without metal it matters little"
        why = why_no_fork(known[Passes], lab.problem.geometry.views)
        return why or why_one_run(len(lab.gaussians), lab.plan, lab.problem, lab.device)

    def ask(self, known: Known, lab: Lab) -> Answer:
        """Both ways are tried on the rays at metal, and the run goes on as these are explained."""
        run = lab.run
        assert run is not None
        if not run.clock.allows(_SLOWER):
            raise Untold("the time budget is kept for the fit")
        near, left = close_up(run.fitter, _VIEWS), []
        if near is None:
            raise Untold("no ray meets metal")
        for rays in (1, AVERAGED_RAYS):
            clock = copy.copy(run.clock)
            branch = lab.branch(near.rays, _OF_A_STEP, pixel_rays=rays)
            branch.ahead(clock, _PASSES)
            if clock.late:
                raise Untold("the time budget was used before the rays could tell")
            left.append(near.misfit_at_metal(branch))
            # A GPU need not have room for both.
            del branch
        share = left[1] / left[0] if left[0] else float("inf")
        verdict = PixelLight.gate({"share": share})
        averaged, why = verdict.kept, verdict.why
        if averaged:
            run.fitter = lab.branch(pixel_rays=AVERAGED_RAYS)
        logger.info("Pixels: %s.", why)
        return Answer(AVERAGED_RAYS if averaged else 1, why, Status.ASKED, {"share": share})

    def alternative(self, lab: Lab) -> str:
        """Saying it saves the question."""
        if lab.settings.pixel_rays or not lab.plan.blurred:
            return ""
        rays = "twice" if lab.problem.planar else "four times"
        return f"1 or 2: not asked in the middle of the run; with 2 {rays} the pairs"
