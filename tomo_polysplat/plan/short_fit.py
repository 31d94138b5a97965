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
from tomo_polysplat.fit.optimise import FitOutcome
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import Rays, batches_around
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.physics.scatter import Scatter
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
    darkest_rays : array
        The P of each of these.
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
    darkest_rays: np.ndarray
    soft_density: float | None
    rays: RaySample
    scatter_level: float
    cut: bool = False

    def share_of_darkest(self, scatter: Scatter) -> float:
        """How much of the light of the darkest rays this scatter would be, at least 0 and at most 1."""
        light = torch.exp(-torch.as_tensor(self.darkest_rays, dtype=torch.float64))
        total = float(light.sum())
        # What is around a dark ray is taken for as dark.
        return min(max(float(scatter.at(light).sum()) / total, 0.0), 1.0) if total else 0.0

    def record(self) -> dict[str, float]:
        """Its numbers, for the plan."""
        numbers = self.fitted | {"held_out": self.held_out, "darkest": self.darkest}
        return numbers if self.soft_density is None else numbers | {"soft_density": self.soft_density}


# The scan and its start, and by what one question's fits differ from another's.
def short_fit(
    problem: Problem,
    start: torch.Tensor,
    fitted: dict[str, float],
    options: FitOptions,
    fewest_steps: int = _FEWEST_STEPS,
    *,
    density: bool = False,
    held_out: float = 0.0,
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
    held_out : float
        Share of the rays held out at least, to be looked at after the fit. By default those of the settings are
        looked at, on the way.

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
    aside = max(settings.held_out, held_out)
    short = replace(settings, passes=min(passes, plan.passes), soft_gain=0.0, held_out=aside)
    scene, rays = scene_of(problem, plan, short, device), rays_of(problem, plan, short, device)
    seeds, _ = first_gaussians(start, plan, problem, short, device)
    short = replace(short, tv_weight=weights_by_depth(plan.depth, rays)[0] * settings.tv_weight)
    outcome = fitted_shortly(seeds, plan, problem, scene, rays, replace(options, settings=short))
    with torch.no_grad():
        main = _main_density_of(outcome, scene, plan.reference, settings) if density else None
        sample = sample_rays(outcome.gaussians, scene, rays, options.seed)
        after, darkest, darkest_rays = _left(outcome.gaussians, scene, rays, short)
    level = problem.scatter_level(device)
    cut = outcome.stop is not None and outcome.stop.by_time
    left = after if held_out else _least_on_the_way(outcome)
    return ShortFit(fitted, left, darkest, darkest_rays, main, sample, level, cut=cut)


def _main_density_of(outcome: FitOutcome, scene: FitScene, reference: float, settings: Settings) -> float:
    volume = scene.volume(outcome.gaussians).cpu().numpy() * reference
    return main_density(volume, settings.metal_level * reference)


def _least_on_the_way(outcome: FitOutcome) -> float:
    """The least misfit of the held-out rays, or of the fitted ones where there are too few."""
    errors = [entry["held_out"] or entry["loss"] for entry in outcome.history] or [np.inf]
    return float(min(errors))


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


def _left(
    gaussians: Gaussians, scene: FitScene, rays: Rays, settings: Settings
) -> tuple[float, float, np.ndarray]:
    """Mean misfit of the held-out rays, and of those with the least light, whose P it tells; in views all around."""
    parts: list[list[torch.Tensor]] = []
    for views, measured, weight, aside in batches_around(rays):
        predicted, _ = scene.projections(gaussians, views)
        used = (weight + aside) > 0
        parts.append([values[used] for values in (predicted, measured, weight, aside)])
    predicted, measured, weight, aside = (torch.cat(part) for part in zip(*parts))
    if not len(measured):
        return 0.0, 0.0, np.zeros(0, np.float32)
    chosen = measured.topk(max(1, round(_DARKEST * len(measured)))).indices
    darkest = misfit(predicted[chosen], measured[chosen], (weight + aside)[chosen], settings)
    return float(misfit(predicted, measured, aside, settings)), float(darkest), measured[chosen].cpu().numpy()
