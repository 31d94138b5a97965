"""A scan by joined pixels and voxels, for fits that show where edges lie and not how fine they are."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from tomo_polysplat.fit.host_rays import HostRays
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.surroundings import NO_MARGIN
from tomo_polysplat.parallel import run_tasks, split_range
from tomo_polysplat.scan.geometry import VolumeGrid
from tomo_polysplat.settings import Settings

__all__ = ["LEAST_PASSES", "coarse_problem", "coarse_settings", "joined_pixels", "small_problem"]

# A run of fewer passes is not asked by joined pixels: these are a quarter of all, or less, and a pass over them would
# take more than a tenth of it.
LEAST_PASSES = 2.5
# Voxels of the coarsest volume along its edges, and the share of rays that is held out of a fit.
_FEWEST_VOXELS, _HELD_OUT = 8, 0.1
# Views of a small problem, over the columns that are left.
_VIEWS = 1.25
# Rays that are joined at once.
_AT_ONCE = 1 << 22


def coarse_problem(problem: Problem, factor: int) -> tuple[Problem, int]:
    """The problem by joined pixels and voxels, and how many rows are joined.

    Parameters
    ----------
    problem : Problem
    factor : int
        Columns, and rows where there are several, that are joined to one.
    """
    rows = min(factor, problem.geometry.rows)
    geometry = problem.geometry.binned(factor, rows)
    voxels = [n if n == 1 else max(_FEWEST_VOXELS, n // factor) for n in problem.grid.shape]
    grid = VolumeGrid((voxels[0], voxels[1], voxels[2]), problem.grid.lower, problem.grid.upper)
    values = joined_pixels(problem.projections, rows, factor)
    behind = None if problem.filter_map is None else problem.filter_map.joined(rows, factor)
    whole = replace(problem, projections=values, geometry=geometry, grid=grid, margin=NO_MARGIN)
    return replace(whole, filter_map=behind), rows


def small_problem(problem: Problem, columns: int) -> Problem:
    """The problem by joined pixels, so many columns of them at least, and by as many of its views as these need.

    What beam and filters did shows in it as well, whatever the scan's size.
    """
    geometry = problem.geometry
    factor = max(1, geometry.columns // columns)
    every = max(1, int(geometry.views / (_VIEWS * (geometry.columns // factor))))
    if every > 1:
        some = np.arange(0, geometry.views, every)
        problem = replace(problem, projections=problem.projections[some], geometry=geometry.select(some))
    return coarse_problem(problem, factor)[0]


def coarse_settings(settings: Settings) -> Settings:
    """Those of such a fit."""
    held_out = max(_HELD_OUT, settings.held_out)
    return replace(settings, pixel_rays=1, growth=1.0, edges="blurred", soft_gain=0.0, held_out=held_out)


def joined_pixels(values: np.ndarray | HostRays, rows: int, columns: int) -> np.ndarray:
    """Means of so many rows and columns together, of those that are no NaN; the rest at the far ends is dropped."""
    if rows == columns == 1:
        return np.asarray(values)
    views, height, width = len(values), values.shape[1] // rows, values.shape[2] // columns
    joined = np.empty((views, height, width), np.float32)

    def join(first: int, last: int) -> None:
        some = values[first:last, : height * rows, : width * columns]
        parts = some.reshape(len(some), height, rows, width, columns)
        good = np.isfinite(parts)
        sums = np.where(good, parts, 0).sum(axis=(2, 4), dtype=np.float64)
        counts = good.sum(axis=(2, 4))
        joined[first:last] = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)

    at_once = max(1, _AT_ONCE // math.prod(values.shape[1:]))
    run_tasks(join, split_range(views, -(-views // at_once)))
    return joined
