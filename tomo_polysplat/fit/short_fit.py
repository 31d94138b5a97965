"""A fit of a few passes over the views, to see what becomes of a scan under some physics."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage

from tomo_polysplat.fit.depth import weights_by_depth
from tomo_polysplat.fit.first_gaussians import first_gaussians
from tomo_polysplat.fit.loss import misfit
from tomo_polysplat.fit.optimise import FitOutcome, fit
from tomo_polysplat.fit.plan import Plan, make_plan
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import Rays, batches_around, views_around
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.physics.scatter import Scatter, light_around
from tomo_polysplat.render.renderer import project_gaussians
from tomo_polysplat.settings import Settings
from tomo_polysplat.start.levels import mass_level

__all__ = [
    "TOO_SHORT",
    "RaySample",
    "ShortFit",
    "Untold",
    "cut_short",
    "fitted_shortly",
    "main_density",
    "sample_rays",
    "short_fit",
    "views_of_short_steps",
]

# Why a short fit that the time budget ended tells nothing.
TOO_SHORT = "the time budget is too short to tell"
_PASSES = 2.0
# A scan of few views is not seen in fewer steps.
_FEWEST_STEPS = 120
# Of the seconds that a reconstruction may take, the share for each short fit.
_SHARE_OF_BUDGET = 0.1
_RAYS = 60_000
# Rays that see no more than this share of what the densest one sees pass beside the object.
_HAZE = 1e-3
# A ray with so much less light than it should have, and so many deviations less, is darker.
_LESS, _DEVIATIONS = 0.85, 3.0
# As few rays beside the object do not tell how bright the beam is.
_FEWEST_BESIDE = 100
# Share of the rays that count as the darkest.
_DARKEST = 0.02
# The main matter's voxels: this share of those inside of it, the ones closest to each other.
_CROWD = 0.3
# As large a share of them has to lie inside. Walls a voxel or two thick look lighter than they are: those of a pepper
# by up to 40 %, with shares of at most 0.19, while a chest wall with 0.22 is right to 2 %.
_SOLID = 0.2


@dataclass(frozen=True)
class RaySample:
    """Some rays of a fit.

    Attributes
    ----------
    areal : (curves, rays) array
        Areal densities in g/cm2.
    measured, weight : (rays,) arrays
        Their P, and the inverse of its deviation, 1 for a ray without noise.
    light : (rays,) array
        That around them; see `tomo_polysplat.physics.scatter.light_around`.
    view : (rays,) array
        Which of the views looked at they belong to.
    photons : float
        Of an unattenuated ray.
    """

    areal: np.ndarray
    measured: np.ndarray
    weight: np.ndarray
    light: np.ndarray
    view: np.ndarray
    photons: float = math.inf

    @property
    def beside(self) -> np.ndarray:
        """Which of them pass beside the object, but for a haze."""
        seen = self.areal.sum(axis=0)
        return seen <= _HAZE * seen.max(initial=0.0)

    def beam(self) -> float:
        """How many times as bright as the open field the rays beside the object are; 1 where there are too few."""
        values = self.measured[self.beside]
        return float(np.exp(-np.median(values))) if len(values) >= _FEWEST_BESIDE else 1.0

    def darker_than(self, scatter: Scatter) -> int:
        """How many rays have less light than their scatter alone, whatever their noise."""
        least = scatter.at(torch.as_tensor(self.light)).numpy()
        # Of Poisson counts the variance of -log(I/I0) is exp(P)/I0.
        deviation = np.sqrt(np.exp(self.measured) / self.photons)
        return int(np.count_nonzero(np.exp(_DEVIATIONS * deviation - self.measured) < _LESS * least))


@dataclass
class ShortFit:
    """What a short fit tells.

    Attributes
    ----------
    fitted : dict
        The physics that was assumed; see ``fit.calibrated_physics.with_fitted``.
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
    settings: Settings,
    device: torch.device,
    seed: int,
    time_budget: float | None,
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
    settings : Settings
        Of the fit to come.
    seed : int
    time_budget : float or None
        Seconds of the whole reconstruction.
    fewest_steps : int
        Steps of the optimiser at least.
    density : bool
        Whether the density of the main matter is to be told.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C: what a calibration has so far is no result.
    """
    # What is calibrated is judged by the areal densities of all three curves.
    plan = make_plan(start, problem, replace(settings, curves=3), device.type)
    passes = max(_PASSES, fewest_steps * views_of_short_steps(plan, problem) / problem.geometry.views)
    # The soft matter stays what it was said to be: calibration asks what else could explain the rays.
    short = replace(settings, passes=min(passes, plan.passes), soft_gain=0.0)
    scene, rays = problem.scene(plan, short, device), problem.rays(plan, short, device)
    seeds = first_gaussians(start, plan, problem, short, device)
    short = replace(short, tv_weight=weights_by_depth(plan.depth, rays)[0] * settings.tv_weight)
    outcome = fitted_shortly(seeds, plan, problem, scene, rays, short, seed, time_budget)
    main = None
    with torch.no_grad():
        if density:
            volume = scene.volume(outcome.gaussians).cpu().numpy() * plan.reference
            main = main_density(volume, settings.metal_level * plan.reference)
        sample = sample_rays(outcome.gaussians, scene, rays, seed)
        darkest = _darkest(outcome.gaussians, scene, rays, short)
    errors = [entry["held_out"] or entry["loss"] for entry in outcome.history] or [np.inf]
    level = problem.scatter_level(device)
    return ShortFit(fitted, float(min(errors)), darkest, main, sample, level, cut=cut_short(outcome))


def views_of_short_steps(plan: Plan, problem: Problem) -> int:
    """Views of a step where passes are few: fewer than in the run, but in slices, whose steps are few as it is."""
    return plan.views_per_step if problem.planar else -(-2 * plan.views_per_step // 3)


def fitted_shortly(
    seeds: Gaussians,
    plan: Plan,
    problem: Problem,
    scene: FitScene,
    rays: Rays,
    settings: Settings,
    seed: int,
    time_budget: float | None,
) -> FitOutcome:
    """Seeds fitted for the settings' passes, or for a share of the seconds of the whole reconstruction.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C: what was fitted so far is no result.
    """
    started = time.perf_counter()
    outcome = fit(
        seeds,
        plan.spacing * problem.voxel,
        rays,
        scene,
        replace(settings, growth=1.0),
        views_per_step=views_of_short_steps(plan, problem),
        rng=np.random.default_rng(seed),
        started=started,
        deadline=None if time_budget is None else started + _SHARE_OF_BUDGET * time_budget,
        volume=lambda gaussians: scene.volume(gaussians).cpu().numpy(),
    )
    if outcome.reason == "interrupted":
        raise KeyboardInterrupt("interrupted during a short fit: there is no result yet")
    return outcome


class Untold(Exception):
    """Short fits that tell nothing, and why."""


def cut_short(outcome: FitOutcome) -> bool:
    """Whether the time budget ended a short fit, which then tells nothing."""
    return outcome.reason.startswith("the time budget")


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


@torch.no_grad()
def sample_rays(gaussians: Gaussians, scene: FitScene, rays: Rays, seed: int, most: int = _RAYS) -> RaySample:
    """So many of the rays at most, of views all around."""
    parts: list[list[np.ndarray]] = []
    weights, rng = gaussians.weights(scene.reference_curve), np.random.default_rng(seed)
    seen, views_in_all = 0, views_around(rays)
    for views, measured, weight, aside in batches_around(rays):
        areal, _ = project_gaussians(gaussians, weights, views, scene.kernel, scene.cutoff)
        weight = weight + aside
        light = light_around(torch.where(weight > 0, measured, torch.nan))
        used = (weight.reshape(-1) > 0).nonzero()[:, 0]
        many = min(len(used), -(-most * len(measured) // views_in_all))
        chosen = used[torch.from_numpy(rng.choice(len(used), many, replace=False)).to(used.device)]
        view, seen = seen + chosen // measured[0].numel(), seen + len(measured)
        flat = [areal.reshape(len(areal), -1)[:, chosen] * scene.areal_scale]
        flat += [values.reshape(-1)[chosen] for values in (measured, weight, light)]
        parts.append([tensor.double().cpu().numpy() for tensor in (*flat, view)])
    whole = [np.concatenate(part, axis=-1) for part in zip(*parts)]
    return RaySample(whole[0], whole[1], whole[2], whole[3], whole[4], rays.photons)
