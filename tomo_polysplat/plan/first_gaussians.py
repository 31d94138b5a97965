"""Gaussians to start a fit from, and what they cost."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from tomo_polysplat.fit.memory import StepSize, has_room, require_room, room_for_gaussians, start_stays
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.free_memory import MUCH, give_back, keeps_more_than
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.model.seed import Spacing, seed_gaussians
from tomo_polysplat.plan.costs import work
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.plan.resolution import finest_spacing, most_seeds
from tomo_polysplat.ranks import current_ranks
from tomo_polysplat.settings import Settings

__all__ = ["AVERAGED_RAYS", "first_gaussians", "room_for_seeds", "room_to_grow", "why_one_run"]

# Rays a pixel and axis where the light is averaged: with three pins of 36^3 are no better than with two (45.4 and 48.4
# dB everywhere).
AVERAGED_RAYS = 2
# Largest number of Gaussians that is worth its time, those of metal included, as a multiple of the number of seeds.
_OF_SEEDS = 2
# Memory of a single run whose cloud grows, over that of one of as many: the smaller cloud and its moments, 152 B a
# Gaussian, are there while the larger one's step is made, by 212. What two runs take is more anyway.
_GROWING = 1.75


def first_gaussians(
    start: np.ndarray | torch.Tensor, plan: Plan, problem: Problem, settings: Settings, device: torch.device
) -> tuple[Gaussians, dict[str, Any]]:
    """Seeds of a start volume, and their number, work and memory as facts for the plan.

    Parameters
    ----------
    start : (nz, ny, nx) array or tensor
        First reconstruction in the solver's units (`plan.first_volume`).
    plan : Plan
    problem : Problem
    settings : Settings
    device : torch.device

    Raises
    ------
    ValueError
        If a CUDA device has too little memory left.
    """
    gaussians, several = _seeded(start, plan, problem, settings, device), plan.curves > 1
    free = int((gaussians.group < 0).sum())
    kinds = "none with a material number of its own"
    if several:
        kinds = f"the material number free for {free} and for {len(gaussians.shared_material) - 1} pieces of metal"
    values = problem.measured(device)
    many = math.ceil(_times(settings.growth or 1.0, plan) * len(gaussians))
    runs = 1 if why_one_run(many, plan, problem, device) else _runs(plan)
    there = values.nbytes if values.device.type == device.type else 0
    memory = require_room(device, _step_size(many, plan, problem, runs), there)
    if (ranks := current_ranks().count) > 1:
        memory = f"on the first of {ranks} devices {memory}"
    return gaussians, {
        "gaussians": (len(gaussians), kinds),
        "work": ("", work(plan, problem, settings, len(gaussians))),
        "memory": ("", memory),
    }


def _seeded(
    start: np.ndarray | torch.Tensor, plan: Plan, problem: Problem, settings: Settings, device: torch.device
) -> Gaussians:
    """The seeds on the device, made on the host where there is no room for what that takes."""
    spacing = plan.spacing * problem.voxel
    # A spacing that was asked for is nobody's lack of Gaussians, which thin ones make up for.
    finest = math.inf if settings.seed_spacing else finest_spacing(problem)[0] * problem.voxel
    finest = 0.0 if plan.sharp else finest
    stays = start_stays(math.prod(start.shape), device)
    gaussians = seed_gaussians(
        # Nobody else holds it: seeding lets go of it early.
        torch.as_tensor(start / (problem.depth * plan.reference)).to(device if stays else "cpu"),
        problem.grid,
        Spacing(spacing, plan.finer, finest),
        plan.adapted(settings),
        plan.curves > 1,
        problem.planar,
    )
    gaussians = gaussians if stays else gaussians.to(device)
    if keeps_more_than(MUCH, device):
        # As the start volume is moved (`plan.first_volume`).
        gaussians = gaussians.to(torch.device("cpu"))
        give_back()
        gaussians = gaussians.to(device)
    return gaussians


def room_to_grow(gaussians: int, plan: Plan, problem: Problem, device: torch.device) -> float:
    """How many times as many Gaussians there would be memory for, and on a GPU be worth their time.

    Parameters
    ----------
    gaussians : int
    plan : Plan
    problem : Problem
    device : torch.device
    """
    room = room_for_gaussians(device, _step_size(0, plan, problem, _runs(plan)))
    room /= _GROWING if _runs(plan) == 1 else 1.0
    if device.type != "cpu":
        room = min(room, _OF_SEEDS * most_seeds(problem))
    return room / max(gaussians, 1)


def room_for_seeds(views: int, problem: Problem, device: torch.device) -> float:
    """How many Gaussians a GPU has memory for in one run, whose steps have so many views; infinity without one.

    A second run, which only questions need, is not made where there is no room for it (`why_one_run`).
    """
    if device.type == "cpu" or not torch.cuda.is_available():
        return math.inf
    pixels, voxels = problem.geometry.rows * problem.geometry.columns, math.prod(problem.grid.shape)
    return room_for_gaussians(device, StepSize(0, views, pixels, voxels))


def why_one_run(gaussians: int, plan: Plan, problem: Problem, device: torch.device) -> str:
    """Why no second run is made beside the first, to ask the rays which of two models explains them, if so."""
    if has_room(device, _step_size(gaussians, plan, problem, _runs(plan))):
        return ""
    return "there is no room on the GPU for a second run beside it"


def _times(growth: float, plan: Plan) -> float:
    """Memory of a cloud that grows so many times, over that of the seeds alone."""
    return growth * _GROWING if growth > 1 and _runs(plan) == 1 else max(growth, 1.0)


def _runs(plan: Plan) -> int:
    """How many runs there are at once.

    While it is asked whether pixels average light there are two, of thin rays and of averaged ones; while it is asked
    whether light matter is fat, two of the same.
    """
    return 1 if plan.pixel_rays and plan.fat is not None else 2


def _step_size(gaussians: int, plan: Plan, problem: Problem, runs: int) -> StepSize:
    """What the memory of a step goes with.

    On each rank that is all images of a step, and the voxels that its Gaussians reach, which may be all.
    """
    rays = runs * (plan.pixel_rays or 1) ** 2
    if runs > 1 and not plan.pixel_rays:
        rays = 1 + AVERAGED_RAYS**2
    pixels = rays * problem.geometry.rows * problem.geometry.columns
    return StepSize(gaussians, plan.views_per_step, pixels, math.prod(problem.grid.shape), runs)
