"""Gaussians to start a fit from, and what they cost."""

from __future__ import annotations

import math

import numpy as np
import torch

from tomo_polysplat.fit.memory import most_gaussians, require_room, room_for_gaussians
from tomo_polysplat.fit.plan import AVERAGED_RAYS, Plan
from tomo_polysplat.fit.plan_costs import alternatives, work
from tomo_polysplat.fit.plan_seeds import finest_spacing
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.model.seed import seed_gaussians
from tomo_polysplat.settings import Settings

__all__ = ["first_gaussians", "room_to_grow"]


def first_gaussians(
    start: np.ndarray | torch.Tensor, plan: Plan, problem: Problem, settings: Settings, device: torch.device
) -> Gaussians:
    """Seeds of a start volume; their number, work and memory are written down in the plan's reasons.

    Parameters
    ----------
    start : (nz, ny, nx) array or tensor
        First reconstruction in the solver's units (``fit.first_volume``).
    plan : Plan
    problem : Problem
    settings : Settings
    device : torch.device

    Raises
    ------
    ValueError
        If a CUDA device has too little memory left.
    """
    relative = start / (problem.depth * plan.reference)
    spacing = plan.spacing * problem.voxel
    # A spacing that was asked for is nobody's lack of Gaussians, which thin ones make up for.
    finest = math.inf if settings.seed_spacing else finest_spacing(problem)[0] * problem.voxel
    finest = 0.0 if plan.sharp else finest
    several = plan.curves > 1
    gaussians = seed_gaussians(
        relative,
        problem.grid,
        spacing,
        plan.adapted(settings),
        several,
        problem.planar,
        device,
        plan.finer,
        finest,
    )
    free = int((gaussians.group < 0).sum())
    plan.reasons["gaussians"] = f"{len(gaussians)}" + (
        f", the material number free for {free} and for {len(gaussians.shared_material) - 1} pieces of metal"
        if several
        else ", none with a material number of its own"
    )
    plan.reasons["work"] = work(plan, problem, settings, len(gaussians))
    plan.reasons["alternatives"] = alternatives(plan, problem, settings, len(gaussians))
    values = problem.measured(device)
    plan.reasons["memory"] = require_room(
        device,
        gaussians=math.ceil(_runs(plan) * max(settings.growth, 1.0) * len(gaussians)),
        **_all_else(plan, problem),
        projections=values.nbytes if values.device.type == device.type else 0,
    )
    return gaussians


def room_to_grow(gaussians: int, plan: Plan, problem: Problem, device: torch.device) -> float:
    """How many times as many Gaussians there would be memory for.

    Parameters
    ----------
    gaussians : int
    plan : Plan
    problem : Problem
    device : torch.device
    """
    room = room_for_gaussians(device, **_all_else(plan, problem)) / _runs(plan)
    return min(room, most_gaussians(device)) / max(gaussians, 1)


def _runs(plan: Plan) -> int:
    """How many runs there are at once.

    While it is asked whether pixels average light there are two, of thin rays and of averaged ones; while it is asked
    whether light matter is fat, two of the same.
    """
    return 1 if plan.pixel_rays and plan.fat is not None else 2


def _all_else(plan: Plan, problem: Problem) -> dict[str, int]:
    """What memory is needed for besides Gaussians, as `fit.memory` asks."""
    rays = _runs(plan) * plan.pixel_rays**2 if plan.pixel_rays else 1 + AVERAGED_RAYS**2
    return {
        "views": plan.views_per_step,
        "pixels": rays * problem.geometry.rows * problem.geometry.columns,
        "voxels": math.prod(problem.grid.shape),
    }
