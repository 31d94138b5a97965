"""How many Gaussians a volume is given, how close they are seeded and how thin they may become."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from tomo_polysplat.fit.memory import most_gaussians
from tomo_polysplat.model.seed_samples import box_mean, widened
from tomo_polysplat.settings import Settings

if TYPE_CHECKING:
    from tomo_polysplat.fit.problem import Problem

__all__ = ["cells", "closer_spacing", "finest_spacing", "seed_spacing", "smallest_scale"]

# Seeds along the longest edge: a ray through few large voxels tells what is inside them, and an object's outline
# in a handful of Gaussians would leave its mass wrong.
_FEWEST_SEEDS = 12
# Voxels between seeds, or detector pixels where these are larger or voxels are few; and voxels between those of a cloud
# of at most so many, thin across edges. Fourteen scans of 30^3 to 72^3 with such small clouds gain 0.3 dB in the
# mean by it (-0.3 to +1.3) and take a tenth more time; 1 voxel apart a pepper loses 0.7 dB. Eight with more seeds came
# to -0.5 to +0.4 dB.
_APART, _CLOSER, _SMALL_CLOUD = 1.3, 1.15, 6000
# Smallest deviation of a Gaussian in voxels. Where a volume has fewer Gaussians than the detector could tell apart,
# each shows more of an edge: half as thick (H200, six scenes of 128^3 to 256^3) 0.8 dB more everywhere in the mean,
# 0.05 without metal. Where they are many (40^3), and in slices, that changed nothing or lost 0.1 dB.
_SMALLEST, _SMALLEST_OF_FEW = 0.2, 0.1
# Gaussians that a laptop fits in a time people wait for. A GPU has memory for so many, of which metal, seeded twice
# as closely and not counted, may take half.
_MOST_ON_CPU, _SHARE_OF_SEEDS = 60_000, 0.5
# What a cloud has to show is mostly surfaces. Where they have more than so many Gaussians a voxel, fewer but thin ones
# are better and quicker (128^3, teeth, pins, pancreas: 43.6, 36.6, 40.0 dB in 2.1 s with 450 000 of them, 44.6, 37.6,
# 40.4 in 1.3 s with 150 000), unless they are few anyway (64^3: 40.9 for 41.8 dB).
_MOST_PER_SURFACE, _NOT_TOO_MANY = 1.7, 60_000


def seed_spacing(
    start: np.ndarray | torch.Tensor,
    least: float,
    support: int,
    problem: Problem,
    settings: Settings,
    device: str,
    dense: float = math.inf,
) -> tuple[float, float, str]:
    """Distance of the seeds in voxels (the shortest edge), the finer share, and why.

    Matter is what is above ``least``, dense matter what is above ``dense``; ``support`` voxels have some.
    """
    if settings.seed_spacing:
        return settings.seed_spacing, 0.0, "asked for"
    most, limit = _most_gaussians(start, (least, dense), problem, settings, device)
    finest, because = finest_spacing(problem)
    crowded = (cells(support, problem) / most) ** (1 / problem.dimensions)
    if crowded <= finest:
        return finest, 0.0, because
    because = f"at most {most} Gaussians{limit} over {support} voxels of support"
    finer = settings.finer_seeds
    because += f", {finer:.0%} of them closer where the start varies"
    return crowded, finer, because + (", thin across its edges" if settings.seed_edge else "")


def closer_spacing(spacing: float, seeds: int, settings: Settings) -> tuple[float, str]:
    """Distance in voxels of seeds that are thin across edges, so many if they lay ``spacing`` apart, and why.

    Empty where it stays as it is.
    """
    if settings.seed_spacing or spacing != _APART or seeds > _SMALL_CLOUD:
        return spacing, ""
    return _CLOSER, f"closer than {_APART:g} voxels, as they are thin across sharp edges, and few"


def smallest_scale(spacing: float, problem: Problem, settings: Settings) -> tuple[float, str]:
    """Smallest deviation in voxels of Gaussians whose seeds lie so far apart, and why."""
    if settings.smallest_scale:
        return settings.smallest_scale, "asked for"
    if problem.planar or spacing <= finest_spacing(problem)[0]:
        return _SMALLEST, "Gaussians are many enough to show edges together"
    return _SMALLEST_OF_FEW, "as Gaussians are few, each shows more of an edge"


def cells(voxels: int, problem: Problem) -> float:
    """So many voxels in cubes, or squares, of their shortest edge."""
    return voxels * float(np.prod(problem.grid.voxel_size[: problem.dimensions] / problem.voxel))


def _most_gaussians(
    start: np.ndarray | torch.Tensor,
    levels: tuple[float, float],
    problem: Problem,
    settings: Settings,
    device: str,
) -> tuple[int, str]:
    """How many Gaussians at most, and why not more; matter and dense matter are what is above ``levels``."""
    if settings.max_gaussians or device == "cpu":
        return settings.max_gaussians or _MOST_ON_CPU, ""
    room = _SHARE_OF_SEEDS * most_gaussians(torch.device(device))
    most = max(round(min(room, math.prod(start.shape))), 1)
    told = ", for which there is memory," if room < math.prod(start.shape) else ""
    if problem.planar:
        return most, told
    # Averaged, as noise would make holes with surfaces of their own. What is dense has surfaces within other matter.
    mean, surface = box_mean(torch.as_tensor(start), np.minimum(3, start.shape)), 0
    for level in levels:
        matter = mean > level
        surface += int((matter & widened(~matter, 1)).sum())
    enough = max(_NOT_TOO_MANY, round(_MOST_PER_SURFACE * surface * cells(1, problem) ** (2 / 3)))
    return (most, told) if most <= enough else (enough, f", for {surface} voxels at its surfaces,")


def finest_spacing(problem: Problem) -> tuple[float, str]:
    """Distance of seeds in voxels, and why.

    No closer than the detector can tell apart and the voxels can show, unless these are few.
    """
    width, height = problem.geometry.pixel_size_at(problem.grid.centre)
    pixel = (width if problem.planar else math.sqrt(width * height)) / problem.voxel
    edge = float((problem.grid.extent / problem.voxel)[: problem.dimensions].max())
    if pixel > 1.0:
        return _APART * pixel, f"{_APART} detector pixels at the object"
    few = max(_APART * pixel, edge / _FEWEST_SEEDS)
    if few < _APART - 1e-6:
        return few, f"a volume of few voxels: {_FEWEST_SEEDS} seeds along it, or {_APART} detector pixels"
    return _APART, f"{_APART} voxels"
