"""What a short fit tells of assumed physics: how well it explains the rays, and how dense matter comes out.

A question of the plan, which asks how to fit and not what is true, makes its short fits by `Lab.trial`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage

from tomo_polysplat.fit.loss import misfit
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import Rays, batches_around
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.plan.depth import weights_by_depth
from tomo_polysplat.plan.first_gaussians import first_gaussians
from tomo_polysplat.plan.fit_options import FitOptions
from tomo_polysplat.plan.model import rays_of, scene_of
from tomo_polysplat.plan.order import plan_from_start
from tomo_polysplat.plan.ray_sample import RaySample, sample_rays
from tomo_polysplat.plan.trial import fitted_shortly, views_of_short_steps
from tomo_polysplat.settings import Settings
from tomo_polysplat.start.levels import mass_level

__all__ = ["ShortFit", "main_density", "short_fit"]

_PASSES = 2.0
# A scan of few views is not seen in fewer steps.
_FEWEST_STEPS = 120
# Share of the rays that count as the darkest.
_DARKEST = 0.02
# The main matter's voxels: this share of those inside of it, the ones closest to each other.
_CROWD = 0.3
# As large a share of them has to lie inside. Walls a voxel or two thick look lighter than they are: those of a pepper
# by up to 40 %, with shares of at most 0.19, while a chest wall with 0.22 is right to 2 %.
_SOLID = 0.2


@dataclass
class ShortFit:
    """What a short fit tells.

    Attributes
    ----------
    fitted : dict
        The physics that was assumed; see ``plan.calibrated_physics.with_fitted``.
    held_out : float
        Misfit of the held-out rays, or of the fitted ones where there are too few.
    darkest : float
        Misfit of the rays with the least light.
    soft_density : float or None
        Density in g/cm3 of what most of the object is made of besides metal, were it the first material; 0 where that
        is too thin, None where it was not asked for.
    rays : RaySample
        Some of the rays.
    scatter_level : float
        Constant scatter that was assumed, as a fraction of the open beam.
    cut : bool
        Whether the time budget ended it, so that it tells nothing.
    """

    fitted: dict[str, float]
    held_out: float
    darkest: float
    soft_density: float | None
    rays: RaySample
    scatter_level: float
    cut: bool = False

    def record(self) -> dict[str, float]:
        """Its numbers, for the plan."""
        numbers = self.fitted | {"held_out": self.held_out, "darkest": self.darkest}
        return numbers if self.soft_density is None else numbers | {"soft_density": self.soft_density}


def short_fit(
    problem: Problem,
    start: torch.Tensor,
    fitted: dict[str, float],
    options: FitOptions,
    fewest_steps: int = _FEWEST_STEPS,
    *,
    density: bool = False,
) -> ShortFit:
    """Two passes over the views, or more where they are few.

    Parameters
    ----------
    problem : Problem
        Under the physics that ``fitted`` states.
    start : (nz, ny, nx) tensor
        Its start volume on the device.
    fitted : dict
        See `ShortFit`.
    options : FitOptions
        Its settings are those of the fit to come.
    fewest_steps : int
        Steps of the optimiser at least.
    density : bool
        Whether the density of the main matter is to be told.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C: what a calibration has so far is no result.
    """
    settings, device = options.settings, options.device
    # What is calibrated is judged by the areal densities of all three curves.
    plan = plan_from_start(start, problem, replace(settings, curves=3), device)
    passes = max(_PASSES, fewest_steps * views_of_short_steps(plan, problem) / problem.geometry.views)
    # The soft matter stays what it was said to be: calibration asks what else could explain the rays.
    short = replace(settings, passes=min(passes, plan.passes), soft_gain=0.0)
    scene, rays = scene_of(problem, plan, short, device), rays_of(problem, plan, short, device)
    seeds, _ = first_gaussians(start, plan, problem, short, device)
    short = replace(short, tv_weight=weights_by_depth(plan.depth, rays)[0] * settings.tv_weight)
    outcome = fitted_shortly(seeds, plan, problem, scene, rays, replace(options, settings=short))
    main = None
    with torch.no_grad():
        if density:
            volume = scene.volume(outcome.gaussians).cpu().numpy() * plan.reference
            main = main_density(volume, settings.metal_level * plan.reference)
        sample = sample_rays(outcome.gaussians, scene, rays, options.seed)
        darkest = _darkest(outcome.gaussians, scene, rays, short)
    errors = [entry["held_out"] or entry["loss"] for entry in outcome.history] or [np.inf]
    level = problem.scatter_level(device)
    cut = outcome.stop is not None and outcome.stop.by_time
    return ShortFit(fitted, float(min(errors)), darkest, main, sample, level, cut=cut)


def main_density(density: np.ndarray, metal: float = math.inf) -> float:
    """Density of the matter that most of an object is made of: where the voxels inside of it crowd.

    Parameters
    ----------
    density : (nz, ny, nx) array
    metal : float
        What is denser does not count: a wire in a sponge weighs more than the sponge.

    Returns
    -------
    float
        0 where too little of that matter lies inside of it to show its density.
    """
    level = mass_level(density[density <= metal])
    near = (density > 0.6 * level) & (density < 1.6 * level)
    inside = np.sort(density[ndimage.binary_erosion(near, border_value=1)].astype(np.float64))
    if len(inside) < max(1.0, _SOLID * np.count_nonzero(near)):
        return 0.0
    width = max(1, int(_CROWD * len(inside)))
    first = int(np.argmin(inside[width - 1 :] - inside[: len(inside) - width + 1]))
    return float(inside[first : first + width].mean())


def _darkest(gaussians: Gaussians, scene: FitScene, rays: Rays, settings: Settings) -> float:
    """Mean misfit of the rays with the least light."""
    parts: list[list[torch.Tensor]] = []
    for views, measured, weight, aside in batches_around(rays):
        predicted, _ = scene.projections(gaussians, views)
        used = (weight + aside) > 0
        parts.append([values[used] for values in (predicted, measured, weight + aside)])
    predicted, measured, weight = (torch.cat(part) for part in zip(*parts))
    if not len(measured):
        return 0.0
    chosen = measured.topk(max(1, round(_DARKEST * len(measured)))).indices
    return float(misfit(predicted[chosen], measured[chosen], weight[chosen], settings))
