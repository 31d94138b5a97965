"""What the plan's choices cost, and what others would, as far as counting tells.

Seconds depend on the machine and its other work, so only numbers of pairs and factors between them are told.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from tomo_polysplat.fit.stopping import patience_of

if TYPE_CHECKING:
    from tomo_polysplat.fit.plan import Plan
    from tomo_polysplat.fit.problem import Problem
    from tomo_polysplat.settings import Settings

__all__ = ["alternatives", "work"]


def work(plan: Plan, problem: Problem, settings: Settings, gaussians: int) -> str:
    """Pairs of a Gaussian and a pixel, or a voxel, that the seeds make in a pass over the views."""
    width, height = (size / problem.voxel for size in problem.geometry.pixel_size_at(problem.grid.centre))
    deviation = settings.seed_width * plan.spacing
    reach = settings.cutoff * deviation
    pixels = 2 * reach / width if problem.planar else math.pi * reach**2 / (width * height)
    views = problem.geometry.views
    steps = math.ceil(views / plan.views_per_step)
    images = "1 image" if plan.curves == 1 else f"{plan.curves} images"
    return (
        f"{gaussians} Gaussians x {max(1.0, pixels):.0f} pixels x {views} views ="
        f" {gaussians * max(1.0, pixels) * views:.2g} pairs a pass, of {images}; the volume {steps} times"
    )


def alternatives(plan: Plan, problem: Problem, settings: Settings, gaussians: int) -> dict[str, str]:
    """By the name of the setting that overrides a decision, what another choice would cost.

    Parameters
    ----------
    gaussians : int
        That the plan seeds.
    """
    dims = problem.dimensions
    volume = math.prod(float(n) for n in (problem.grid.extent / problem.voxel)[:dims])
    everywhere = volume / plan.spacing**dims
    half = plan.spacing / 2
    told = {
        "seed_spacing": f"{half:.2g}: {2**dims} times the Gaussians, twice the pairs",
        "support_level": f"0: up to {everywhere:.3g} Gaussians for {gaussians}, the empty space with them",
        "passes": f"{2 * plan.passes:g} for {plan.passes:g}: twice the pairs",
        "patience": f"{patience_of(settings, plan.passes)} passes without improvement end it sooner",
        "edges": "sharp or blurred: without two short fits, of about a pass over the views each, that tell which",
        "growth": "4: four times the Gaussians in the end, by splitting, and half to all of the time again; 1: none",
        "tv_factor": "1: without the short fits that tell how strongly thin objects and slices are smoothed",
        "tv_weight": "0: nothing is smoothed, which on a CPU takes about half of the time",
    }
    if plan.blurred:
        rays = "twice" if problem.planar else "four times"
        told["pixel_rays"] = f"1 or 2: not asked in the middle of the run; with 2 {rays} the pairs"
    if plan.views_per_step > 1:
        fewer = plan.views_per_step // 2
        told["views_per_step"] = (
            f"{fewer}: as many pairs, the volume smoothed {plan.views_per_step / fewer:.2g} times as often"
        )
    if problem.polychromatic:
        told["curves"] = (
            "3: three images for one, and the same volume"
            if plan.curves == 1
            else "1: one image for three, and no metal or bone but as dense soft matter"
        )
    return told
