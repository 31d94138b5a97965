"""The thickness of the filter in front of each pixel, fitted together with the object to joined pixels.

An object makes up for most of a bowtie: it becomes too light at its rim. So the misfit of a fit hardly tells whether
there is one, and what a rough fit leaves tells it no better. If the filter is moved after each pass by what is
left, the object gives way, and both come to where they belong.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from tomo_polysplat.checks import fail
from tomo_polysplat.fit.filter_sums import FilterSums, filter_sums
from tomo_polysplat.fit.fitter import next_views
from tomo_polysplat.fit.learning_rates import hurried
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.fit.step import EagerStep
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.nuisances.bowtie import Bowtie
from tomo_polysplat.nuisances.bowtie_estimate import filter_left
from tomo_polysplat.physics.beer_lambert import projection
from tomo_polysplat.physics.filter_map import FilterMap
from tomo_polysplat.physics.filter_shape import bowtie_map, filter_shapes, filter_thickness
from tomo_polysplat.physics.materials import density
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.coarse import coarse_settings, small_problem
from tomo_polysplat.plan.fall_of_misfits import fall_of_misfits
from tomo_polysplat.plan.fit_options import FitOptions
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.plan.preparation import lab_of

__all__ = ["behind_bowtie", "find_bowtie"]

logger = logging.getLogger(__name__)

# Nodes of the spectrum hold up to so many cm of it, and no filter is thicker.
_THICKEST = 5.0
# At least so many columns are left; passes of a fit, and views of a step.
_COLUMNS, _PASSES, _BATCH = 36, 12, 4
# Shares of the passes between which the filter goes along, and by how many times what is left says: the object hides a
# part of it. Before, the object is too rough; afterwards it gets used to it.
_FROM, _UNTIL, _FURTHER = 0.3, 0.8, 1.5


def find_bowtie(problem: Problem, options: FitOptions, report: Callable[[float, str], Any]) -> Answer:
    """Coefficients in cm of aluminium, as `behind_bowtie` takes them; empty where none is confirmed.

    Parameters
    ----------
    problem : Problem
        Without a filter.
    options : FitOptions
    report : callable
        Gets the share done, none, and words.
    """
    report(0.0, "bowtie")
    search = _Search(small_problem(problem, _COLUMNS), options)
    plain, _ = search.fit(moving=False)
    behind, found = search.fit(moving=True)
    better, error = fall_of_misfits(plain.held_out, behind.held_out, -math.inf)
    thickest = float(filter_thickness(found, *problem.projections.shape[1:]).max())
    evidence = {"thickest": thickest, "better": better, "better_error": error}
    verdict, words = Bowtie.gate(evidence), Bowtie.told({Bowtie.name: found})
    if verdict.kept:
        logger.info("Behind %s; %s.", words, verdict.why)
        return Answer(found, f"{words}; {verdict.why}", Status.ASKED, evidence)
    logger.warning("filter_map='fit' found no bowtie: %s.", verdict.why)
    return Answer({}, f"none: {verdict.why}", Status.ASKED, evidence)


def behind_bowtie(problem: Problem, found: dict[str, float]) -> Problem:
    """The problem behind a filter of these coefficients in cm (`physics.filter_shape`); itself where there are none."""
    rows, columns = problem.projections.shape[1:]
    told = bowtie_map(found, rows, columns)
    return problem if told is None else problem.behind(FilterMap.of(told, "cm", rows, columns))


class _Search:
    """Fits of a scan whose pixels may have a filter."""

    def __init__(self, problem: Problem, options: FitOptions) -> None:
        rows, columns = problem.projections.shape[1:]
        self.names, self.shape = tuple(Bowtie.parameters), (rows, columns)
        self.shapes, self.grams = filter_shapes(rows, columns, self.names), density("Al")
        settings = replace(coarse_settings(options.settings), passes=float(_PASSES))
        nothing = np.zeros(self.shape, np.float32)
        problem = problem.behind(FilterMap("Al", nothing, self.grams, _THICKEST * self.grams))
        lab = lab_of(problem, Plan(), replace(options, settings=settings))
        self.scene, self.rays = lab.scene, lab.rays
        if self.scene.quadrature is None:
            raise fail("filter_map", "a scan whose rays are hardened beside 'fit'", "one of thin rays")
        self.seeds = lab.seeds()
        self.spacing, self.seed = lab.plan.spacing * problem.voxel, options.seed
        self.batch = min(_BATCH, len(self.rays.views))
        self.steps_of_a_pass = max(1, round(len(self.rays.views) / self.batch))
        self.settings = hurried(lab.plan.adapted(settings), _PASSES * self.steps_of_a_pass)

    def fit(self, *, moving: bool) -> tuple[FilterSums, dict[str, float]]:
        """What a fit leaves, and the coefficients with which it ends, which go along where they are ``moving``."""
        at = dict.fromkeys(self.names, 0.0)
        self._put(at)
        gaussians = self.seeds.copy()
        step = EagerStep(FitSetup(gaussians, self.spacing, self.rays, self.scene, self.settings))
        rng, order = np.random.default_rng(self.seed), np.empty(0, int)
        for made in range(1, _PASSES + 1):
            for number in range(self.steps_of_a_pass):
                chosen, order = next_views(order, self.batch, len(self.rays.views), rng)
                step(chosen, (made - 1 + number / self.steps_of_a_pass) / _PASSES)
            with torch.no_grad():
                self.scene.keep_within(gaussians)
            if moving and _FROM <= made / _PASSES <= _UNTIL:
                at = self._moved(at, self._sums(gaussians))
                self._put(at)
        return self._sums(gaussians), at

    def _sums(self, gaussians: Gaussians) -> FilterSums:
        assert self.scene.quadrature is not None
        nodes = self.scene.quadrature
        return filter_sums(gaussians, self.scene, self.rays, self.settings, nodes, self.grams)

    def _moved(self, at: dict[str, float], left: FilterSums) -> dict[str, float]:
        """The coefficients after a step, within their ranges."""
        ends = [Bowtie.parameters[name] for name in self.names]
        least = np.array([end.least - at[name] for end, name in zip(ends, self.names)])
        steps = filter_left(left.sums, self.shapes, least)
        return {
            name: float(np.clip(at[name] + _FURTHER * by, end.least, end.most))
            for name, by, end in zip(self.names, steps, ends)
        }

    def _put(self, at: dict[str, float]) -> None:
        """Put a filter in front of the pixels of the scene, which its steps read."""
        scene = self.scene
        assert (
            scene.behind is not None and scene.quadrature is not None and scene.quadrature.filter is not None
        )
        areal = self.grams * np.minimum(filter_thickness(at, *self.shape), _THICKEST)
        alone = projection(areal[None], scene.quadrature.log_weights, scene.quadrature.filter[None])
        scene.behind.copy_(torch.from_numpy(np.stack([areal, alone]).astype(np.float32)))
