"""How close Gaussians may lie for what detector and voxels can show."""

from __future__ import annotations

import math

import numpy as np

from tomo_polysplat.fit.problem import Problem

__all__ = ["APART", "FEWEST_SEEDS", "cells", "finest_spacing", "most_seeds"]

# Seeds along the longest edge: a ray through few large voxels tells what is inside them, and an object's outline
# in a handful of Gaussians would leave its mass wrong.
FEWEST_SEEDS = 12
# Voxels between seeds, or detector pixels where these are larger or voxels are few.
APART = 1.3


# Seeds of a fit on a GPU at most, and of a large detector so many for each of its pixels: what a Gaussian costs grows
# with the views and what it gains falls (bone of 400^3 voxels, 600^2 pixels: 28.5 dB with 8.6 seeds a pixel, 29.1 with
# 17 in 1.4 times the time).
_MANY_SEEDS, _SEEDS_A_PIXEL = 3_000_000, 17


def most_seeds(problem: Problem) -> int:
    """How many seeds are worth their time on a GPU."""
    return max(_MANY_SEEDS, _SEEDS_A_PIXEL * problem.geometry.rows * problem.geometry.columns)


def cells(voxels: int, problem: Problem) -> float:
    """So many voxels in cubes, or squares, of their shortest edge."""
    return voxels * float(np.prod(problem.grid.voxel_size[: problem.dimensions] / problem.voxel))


def finest_spacing(problem: Problem) -> tuple[float, str]:
    """Distance of seeds in voxels, and why.

    No closer than the detector can tell apart and the voxels can show, unless these are few.
    """
    width, height = problem.geometry.pixel_size_at(problem.grid.centre)
    pixel = (width if problem.planar else math.sqrt(width * height)) / problem.voxel
    edge = float((problem.grid.extent / problem.voxel)[: problem.dimensions].max())
    if pixel > 1.0:
        return APART * pixel, f"{APART} detector pixels at the object"
    few = max(APART * pixel, edge / FEWEST_SEEDS)
    if few < APART - 1e-6:
        return few, f"a volume of few voxels: {FEWEST_SEEDS} seeds along it, or {APART} detector pixels"
    return APART, f"{APART} voxels"
