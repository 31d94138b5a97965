"""Whether pixels average the light over their area, asked of the rays at metal in the middle of a run.

Real pixels do, and simulators that send several rays through each; others send one. Who is wrong about it puts up to
a third too little metal there, or a quarter too much. At first a fit is too rough to tell: later the run is
made both ways for a few passes over the views, and goes on as it explains the rays that averaging changes.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

import torch

from tomo_polysplat.fit.fitter import Fitter
from tomo_polysplat.fit.fork import fork, passes_of_a_fork, why_no_fork
from tomo_polysplat.fit.loss import losses
from tomo_polysplat.fit.rays import batches_around
from tomo_polysplat.nuisances.pixel_light import PixelLight
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known, When
from tomo_polysplat.plan.decisions.passes import Passes
from tomo_polysplat.plan.first_gaussians import AVERAGED_RAYS, why_one_run
from tomo_polysplat.plan.lab import Lab, Untold

__all__ = ["PixelRays"]

logger = logging.getLogger(__name__)

# Share of the run after which it is asked, and the steps of each way, but for more than this share of the run: the
# first ones are spent on getting used to it.
_FROM, _STEPS, _MOST = 0.4, 60, 0.2
# So little left after one pass is enough, or more than the limit by this over the steps of a pass: the more there
# were, the less the next ones change (docs/decisions/pixel_rays.md).
_SURELY_AVERAGED, _SURELY_THIN = 1.15, 28.0
# Factor of the time of a step, at most, where light is averaged over two rays a pixel and axis.
_SLOWER = 4.0
# A ray counts by this power of what averaging changes in it, in its deviations, up to so many: what changes less than
# its noise tells nothing, and a few opaque rays are not to decide alone.
_POWER, _ENOUGH = 4, 6.0


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
        """The run is made both ways for some passes, and goes on as it explains the rays that averaging changes."""
        run = lab.run
        assert run is not None
        if not run.clock.allows(_SLOWER):
            raise Untold("the time budget is kept for the fit")
        fitter = run.fitter
        other = lab.branch(pixel_rays=AVERAGED_RAYS)
        shares: list[float] = []

        def settled() -> bool:
            shares.append(_share(fitter, other))
            return _is_settled(shares, fitter.steps_of_a_pass)

        passes = passes_of_a_fork(fitter, known[Passes], _STEPS, _MOST)
        ways = fork(fitter, other, run.clock, passes, settled)
        if ways.late:
            run.made = ways.was
            raise Untold("the time budget was used before the rays could tell")
        share = shares[-1]
        verdict = PixelLight.gate({"share": share})
        averaged, why = verdict.kept, verdict.why
        run.fitter, run.made = (other, ways.other) if averaged else (fitter, ways.was)
        logger.info("Pixels: %s.", why)
        return Answer(AVERAGED_RAYS if averaged else 1, why, Status.ASKED, {"share": share})

    def alternative(self, lab: Lab) -> str:
        """Saying it saves the fork."""
        if lab.settings.pixel_rays or not lab.plan.metal:
            return ""
        rays = "twice" if lab.problem.planar else "four times"
        return f"1 or 2: not asked in the middle of the run; with 2 {rays} the pairs"


def _is_settled(shares: Sequence[float], steps: int) -> bool:
    """Whether the next pass, of so many steps, would have to change the share by more than it is likely to.

    After the first pass by what it did in other scans, later by what the last pass did.
    """
    share, margin = shares[-1], PixelLight.margin(shares[-1])
    if len(shares) > 1:
        return margin > abs(share - shares[-2])
    if PixelLight.gate({"share": share}).kept:
        return share <= _SURELY_AVERAGED
    return margin >= _SURELY_THIN / steps


@torch.no_grad()
def _share(thin: Fitter, averaged: Fitter) -> float:
    """What averaged light leaves of the misfit that thin rays leave.

    Only fitted rays that averaging changes by more than their noise count much. Where both fits miss those by more than
    noise, they all count the more alike: what changes most is missed most, whichever fit is right.
    """
    changed, squares, misfits = (
        torch.cat(parts) for parts in zip(*_changed_rays(thin, averaged), strict=True)
    )
    told = changed >= 1.0
    missed = float(squares[told].mean(0).min()) if bool(told.any()) else 0.0
    counts = (changed * max(missed, 1.0) / _ENOUGH).clamp(max=1.0) ** _POWER
    by_thin, by_averaged = (counts[:, None] * misfits).sum(0, dtype=torch.float64).tolist()
    return by_averaged / by_thin if by_thin else float("inf")


def _changed_rays(
    thin: Fitter, averaged: Fitter
) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Of fitted rays by how many deviations averaging changes them, (rays,), and what either fit leaves, (rays, 2).

    That is the square of what it misses them by, in deviations, and their misfit.
    """
    settings = thin.settings
    for views, measured, weight, _ in batches_around(thin.rays):
        by_thin, _ = thin.scene.projections(thin.gaussians, views)
        by_averaged, _ = averaged.scene.projections(averaged.gaussians, views)
        unaveraged, _ = thin.scene.projections(averaged.gaussians, views)
        changed = ((by_averaged - unaveraged) * weight / settings.model_error).abs()
        both, on = (by_thin, by_averaged), changed > 0
        squares = [((p - measured) * weight / settings.model_error).square()[on] for p in both]
        misfits = [losses(p, measured, weight, settings)[on] for p in both]
        yield changed[on], torch.stack(squares, 1), torch.stack(misfits, 1)
