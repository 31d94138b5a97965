"""What a fit costs, as far as counting tells: seconds depend on the machine and its other work."""

from __future__ import annotations

import math

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.render.renderer import RAY_CUTOFF
from tomo_polysplat.settings import Settings

__all__ = ["work"]


def work(plan: Plan, problem: Problem, settings: Settings, gaussians: int) -> str:
    """Pairs of a Gaussian and a pixel, or a voxel, that the seeds make in a pass over the views."""
    width, height = (size / problem.voxel for size in problem.geometry.pixel_size_at(problem.grid.centre))
    deviation = settings.seed_width * plan.spacing
    reach = RAY_CUTOFF * deviation
    pixels = 2 * reach / width if problem.planar else math.pi * reach**2 / (width * height)
    views = problem.geometry.views
    steps = math.ceil(views / plan.views_per_step)
    images = "1 image" if plan.curves == 1 else f"{plan.curves} images"
    return (
        f"{gaussians} Gaussians x {max(1.0, pixels):.0f} pixels x {views} views ="
        f" {gaussians * max(1.0, pixels) * views:.2g} pairs a pass, of {images}; the volume {steps} times"
    )
