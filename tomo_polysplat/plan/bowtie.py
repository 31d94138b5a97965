"""Whether a filter in front of the pixels is thicker for some, and how thick, as a run and two fits by joined pixels tell.

The object makes up for most of a bowtie as long as a fit is rough: it becomes too dense at its rim. So what a run has
left after a while tells no more than that there is one. Its shape is found by a fit in which it goes on with the
object, from pass to pass.
"""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from tomo_polysplat.fit.filter_sums import FilterSums, filter_sums
from tomo_polysplat.fit.fitter import Fitter, next_views
from tomo_polysplat.fit.learning_rates import hurried
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.fit.step import EagerStep
from tomo_polysplat.nuisances.bowtie import Bowtie
from tomo_polysplat.nuisances.bowtie_estimate import FilterLeft, filter_left
from tomo_polysplat.physics.beer_lambert import projection
from tomo_polysplat.physics.filter_map import FilterMap
from tomo_polysplat.physics.filter_shape import filter_shapes, filter_thickness
from tomo_polysplat.physics.materials import density
from tomo_polysplat.physics.quadrature import Quadrature, fit_quadrature
from tomo_polysplat.physics.scatter import add_scatter
from tomo_polysplat.plan.coarse import coarse_problem, coarse_settings
from tomo_polysplat.plan.first_gaussians import first_gaussians
from tomo_polysplat.plan.first_volume import first_volume
from tomo_polysplat.plan.means import Means
from tomo_polysplat.plan.model import rays_of, scene_of
from tomo_polysplat.plan.order import plan_from_start

__all__ = ["behind_bowtie", "find_bowtie", "shown_bowtie"]

logger = logging.getLogger(__name__)

_MATERIAL = "Al"
# Nodes of the spectrum hold up to so many cm of it, and no filter is thicker.
_THICKEST = 4.0
# Views of a run that are looked at.
_LOOKED_AT = 48
# A fit that finds it has at least so many columns, and this share of them as views; its passes, and views of a step.
_COLUMNS, _VIEWS, _PASSES, _BATCH = 48, 1.25, 12, 4
# Share of them after which the shape goes along, and by how many times what is left says: the object hides the rest.
_FROM, _FURTHER = 0.15, 1.5


def _grams() -> float:
    return density(_MATERIAL)


def behind_bowtie(problem: Problem, found: dict[str, float]) -> Problem:
    """The problem with a filter of these coefficients, in cm (`physics.filter_shape`); itself where there are none."""
    if not found:
        return problem
    return replace_filter(problem, filter_thickness(found, *problem.projections.shape[1:]))


def replace_filter(problem: Problem, thickness: np.ndarray, reach: float = 0.0) -> Problem:
    """The problem behind so many cm of aluminium, (rows, columns)."""
    areal = np.ascontiguousarray(thickness * _grams(), np.float32)
    return problem.behind(FilterMap(_MATERIAL, areal, _grams(), reach * _grams()))


def shown_bowtie(problem: Problem, fitter: Fitter) -> dict[str, float] | None:
    """What a run under way leaves of the rays: ``spread`` and ``error``, in cm; None where its nodes are but one."""
    scene = fitter.scene
    if scene.quadrature is None or problem.spectrum is None:
        return None
    reach = (_MATERIAL, 0.0, 0.1 * _grams())
    of_run = scene.quadrature
    curves = len(of_run.attenuation)
    nodes = fit_quadrature(problem.spectrum, problem.materials, of_run.max_path, curves=curves, behind=reach)
    nodes = add_scatter(nodes, problem.scatter_level(fitter.rays.target))
    rays, settings = fitter.rays, fitter.settings
    sums = filter_sums(fitter.gaussians, scene, rays, settings, nodes, _grams(), _LOOKED_AT)
    names = _names(problem)
    left = filter_left(sums.sums, filter_shapes(rays.views.rows, rays.views.columns, names), _least(names, {}))
    logger.info("A bowtie as the run has it: %s, spread %.3f (%.3f)", dict(zip(names, left.step)), left.spread, left.error)
    return {"spread": left.spread, "error": left.error}


def find_bowtie(problem: Problem, means: Means) -> tuple[dict[str, float], dict[str, float]]:
    """Coefficients of a filter, and by how much, ``better`` and ``better_error``, held-out rays fit better with it."""
    search = _Search(_fewer(problem), means)
    plain, _ = search.fit(moving=False)
    found, coefficients = search.fit(moving=True)
    better, error = _improvement(plain.held_out, found.held_out)
    evidence = {"better": better, "better_error": error}
    logger.info("A bowtie by a fit of joined pixels: %s, %s", coefficients, evidence)
    return {name: value for name, value in coefficients.items() if value}, evidence


def _names(problem: Problem) -> tuple[str, ...]:
    return ("u2", "u4", "u") if problem.projections.shape[1] == 1 else ("u2", "u4", "u", "v")


def _least(names: tuple[str, ...], at: dict[str, float]) -> np.ndarray:
    """Of a step of each from where it is: a bowtie is not thicker in the middle."""
    return np.array([Bowtie.parameters[name].least - at.get(name, 0.0) for name in names])


def _fewer(problem: Problem) -> Problem:
    """The problem by joined pixels, and by some of its views."""
    coarse, _ = coarse_problem(problem, max(1, problem.geometry.columns // _COLUMNS))
    views = len(coarse.projections)
    every = max(1, int(views / (_VIEWS * coarse.geometry.columns)))
    if every == 1:
        return coarse
    some = np.arange(0, views, every)
    return replace(coarse, projections=coarse.projections[some], geometry=coarse.geometry.select(some))


def _improvement(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """By what share the misfits of the views fall, and its standard error."""
    both = np.isfinite(before) & np.isfinite(after)
    fall, mean = (before - after)[both], float(before[both].mean()) if both.any() else 0.0
    if not mean > 0 or len(fall) < 2:
        return 0.0, math.inf
    return float(fall.mean()) / mean, float(fall.std(ddof=1)) / math.sqrt(len(fall)) / mean


class _Search:
    """Fits of a scan whose pixels may have a filter."""

    def __init__(self, problem: Problem, means: Means) -> None:
        self.names, self.shape = _names(problem), problem.projections.shape[1:]
        self.shapes = filter_shapes(*self.shape, self.names)
        device = means.device
        self.settings = replace(coarse_settings(means.settings), passes=float(_PASSES))
        self.seed = means.seed
        problem = replace_filter(problem, np.zeros(self.shape), _THICKEST)
        start, _ = first_volume(problem, device, self.settings)
        plan = plan_from_start(start, problem, self.settings, device)
        self.scene = scene_of(problem, plan, self.settings, device)
        self.rays = rays_of(problem, plan, self.settings, device)
        self.seeds, _ = first_gaussians(start, plan, problem, self.settings, device)
        self.spacing, self.adapted = plan.spacing * problem.voxel, plan.adapted(self.settings)

    def fit(self, *, moving: bool) -> tuple[FilterSums, dict[str, float]]:
        """What a fit leaves, and the coefficients with which it ends; they go along where they are ``moving``."""
        scene, rays = self.scene, self.rays
        at = dict.fromkeys(self.names, 0.0)
        self._put(at)
        gaussians = self.seeds.copy()
        rng, views, order = np.random.default_rng(self.seed), len(rays.views), np.empty(0, int)
        batch = min(_BATCH, views)
        of_a_pass = max(1, round(views / batch))
        settings = hurried(self.adapted, _PASSES * of_a_pass)
        step = EagerStep(FitSetup(gaussians, self.spacing, rays, scene, settings))
        for number in range(_PASSES * of_a_pass):
            chosen, order = next_views(order, batch, views, rng)
            step(chosen, number / (_PASSES * of_a_pass))
            if (number + 1) % of_a_pass == 0:
                with torch.no_grad():
                    scene.keep_within(gaussians)
                if moving and number >= _FROM * _PASSES * of_a_pass:
                    at = self._moved(at, self._left(gaussians, at))
                    self._put(at)
        return self._sums(gaussians), at

    def _sums(self, gaussians: Any) -> FilterSums:
        assert self.scene.quadrature is not None
        return filter_sums(gaussians, self.scene, self.rays, self.settings, self.scene.quadrature, _grams())

    def _left(self, gaussians: Any, at: dict[str, float]) -> FilterLeft:
        return filter_left(self._sums(gaussians).sums, self.shapes, _least(self.names, at))

    def _moved(self, at: dict[str, float], left: FilterLeft) -> dict[str, float]:
        """The coefficients after a step, within their ranges."""
        moved = {}
        for name, by in zip(self.names, left.step):
            ends = Bowtie.parameters[name]
            moved[name] = float(np.clip(at[name] + _FURTHER * by, ends.least, ends.most))
        logger.debug("bowtie %s", moved)
        return moved

    def _put(self, at: dict[str, float]) -> None:
        """Put a filter in front of the pixels of the scene."""
        scene = self.scene
        if scene.behind is None or scene.quadrature is None or scene.quadrature.filter is None:
            return
        areal = _grams() * np.minimum(filter_thickness(at, *self.shape), _THICKEST)
        alone = projection(areal[None], scene.quadrature.log_weights, scene.quadrature.filter[None])
        scene.behind.copy_(torch.from_numpy(np.stack([areal, alone]).astype(np.float32)))
