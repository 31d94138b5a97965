"""Whether pixels average the light over their area, asked of the rays at metal in the middle of a run.

Real pixels do, and simulators that send several rays through each; others send one. Who is wrong about it puts up to
a third too little metal there, or a quarter too much. At first a fit is too rough to tell: later the run is
made both ways for a few passes over the views, and goes on as it explains the rays at metal.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from tomo_polysplat.fit.fitter import Fitter
from tomo_polysplat.fit.fork import Made, fork, passes_of_a_fork, why_no_fork
from tomo_polysplat.fit.loss import misfit
from tomo_polysplat.fit.plan import AVERAGED_RAYS, Plan
from tomo_polysplat.fit.rays import batches_around
from tomo_polysplat.fit.stopping import Clock
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.render.renderer import project_gaussians
from tomo_polysplat.settings import Settings

__all__ = ["PixelAveraging", "pixel_averaging"]

logger = logging.getLogger(__name__)

# Share of the run after which it is asked, and the steps of each way, but for more than this share of the run: the
# first ones are spent on getting used to it.
_FROM, _STEPS, _MOST = 0.4, 60, 0.2
# So many times as long a step of averaged light may take, with two rays a pixel and axis.
_SLOWER = 4.0
# Light is averaged where that leaves as much of the misfit of the rays at metal: a fit makes up for most of what it
# does not model. 40 scans of several rays a pixel came to 0.75 to 1.15, six of thin or opaque metal to 1.16 to 1.55;
# 24 of one ray to 1.32 and more, but for grains smaller than a voxel, 1.06, and for rods in the middle of a disc, which
# all views see alike: 0.34 to 0.99.
_AS_WELL = (0.7, 1.2)
# Rays at metal: they and their neighbours see this share of the most metal that any does.
_SEEN = 0.05


@dataclass(frozen=True)
class PixelAveraging:
    """The question of one run, whose plan gets the answer."""

    plan: Plan

    def due(self, clock: Clock) -> bool:
        """Whether it is to be asked now; where time is too short for it, it is answered without."""
        if self.plan.pixel_rays or clock.share() < _FROM:
            return False
        if clock.allows(_SLOWER):
            return True
        _not_asked(self.plan, "the time budget is kept for the fit")
        return False

    def answered(self, fitter: Fitter, clock: Clock) -> tuple[Fitter, Made | None]:
        """The fitter to go on with, some passes later, and what the last of them gave, if time was left for any."""
        other = fitter.branch(pixel_rays=AVERAGED_RAYS)
        ways = fork(fitter, other, clock, passes_of_a_fork(fitter, self.plan.passes, _STEPS, _MOST))
        if ways.late:
            _not_asked(self.plan, "the time budget was used before the rays could tell")
            return fitter, ways.was
        left = _misfits_at_metal([fitter, other])
        share = left[1] / left[0] if left[0] else float("inf")
        averaged = _AS_WELL[0] <= share <= _AS_WELL[1]
        self.plan.pixel_rays = AVERAGED_RAYS if averaged else 1
        kind = "the light of each pixel is averaged" if averaged else "rays are infinitely thin"
        words = f"averaged light leaves {share:.2f} of the misfit of the rays at metal, and is taken from"
        least, most = _AS_WELL
        self.plan.reasons["pixel_rays"] = f"{self.plan.pixel_rays}: {kind}; {words} {least:g} to {most:g}"
        logger.info("Pixels: %s.", self.plan.reasons["pixel_rays"])
        return (other, ways.other) if averaged else (fitter, ways.was)


def pixel_averaging(
    plan: Plan, gaussians: Gaussians, settings: Settings, views: int
) -> PixelAveraging | None:
    """The question where it can be answered; else the plan gets the answer now.

    Parameters
    ----------
    plan : Plan
        Of a run that begins, or goes on from a checkpoint.
    gaussians : Gaussians
        That it begins with.
    settings : Settings
    views : int
    """
    if settings.pixel_rays:
        plan.reasons["pixel_rays"] = f"{settings.pixel_rays}: asked for"
    if plan.pixel_rays:
        return None
    why_not = _why_not(plan, gaussians, views)
    if not why_not:
        return PixelAveraging(plan)
    _not_asked(plan, why_not)
    return None


def _not_asked(plan: Plan, why: str) -> None:
    plan.pixel_rays = 1
    plan.reasons["pixel_rays"] = f"1, infinitely thin: {why}"


def _why_not(plan: Plan, gaussians: Gaussians, views: int) -> str:
    """Why it is not asked, if so."""
    if not bool((gaussians.group > 0).any()):
        return "without metal it matters little"
    return why_no_fork(plan.passes, views)


@torch.no_grad()
def _misfits_at_metal(fitters: Sequence[Fitter]) -> list[float]:
    """Mean misfit of the fitted rays that meet the first one's metal, and of their neighbours."""
    one, totals, weighed = fitters[0], [0.0 for _ in fitters], 0.0
    for views, measured, weight, _ in batches_around(one.rays):
        weight = weight * _at_metal(one, views)
        sum_of_weights = float(weight.sum())
        weighed += sum_of_weights
        for k, fitter in enumerate(fitters):
            predicted, _ = fitter.scene.projections(fitter.gaussians, views)
            totals[k] += sum_of_weights * float(misfit(predicted, measured, weight, fitter.settings))
    return [total / weighed if weighed else 0.0 for total in totals]


def _at_metal(fitter: Fitter, views: DetectorViews) -> torch.Tensor:
    """(views, rows, columns) whether a ray meets metal, or one beside it does."""
    gaussians, scene = fitter.gaussians, fitter.scene
    metal = torch.where(gaussians.group > 0, gaussians.attenuation, 0.0)
    seen, _ = project_gaussians(gaussians, metal[None], views, scene.kernel, scene.cutoff)
    met = (seen > _SEEN * seen.max()).to(seen.dtype)
    reach = (min(views.rows, 3), min(views.columns, 3))
    padding = (reach[0] // 2, reach[1] // 2)
    return torch.nn.functional.max_pool2d(met, reach, 1, padding)[0, :, : views.rows, : views.columns]
