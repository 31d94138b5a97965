"""How far from each other Gaussians are seeded."""

from __future__ import annotations

import math

import numpy as np
import torch

from tomo_polysplat.model.seed_samples import box_mean, widened
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known
from tomo_polysplat.plan.decisions.support_level import SupportLevel
from tomo_polysplat.plan.first_gaussians import room_for_seeds
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.resolution import cells, finest_spacing, most_seeds

__all__ = ["MOST_VIEWS", "SeedSpacing"]

# Views of a step at most, by the kind of device: what a step makes of them takes memory, too.
MOST_VIEWS = {"cpu": 12, "cuda": 6}

# Gaussians that a laptop fits in a time people wait for. Of what a GPU has memory for metal, seeded twice as closely
# and not counted, may take half.
_MOST_ON_CPU, _SHARE_OF_SEEDS = 60_000, 0.5
# What a cloud has to show is mostly surfaces. Where they have more than so many Gaussians a voxel, fewer but thin ones
# are better and quicker (128^3, teeth, pins, pancreas: 43.6, 36.6, 40.0 dB in 2.1 s with 450 000 of them, 44.6, 37.6,
# 40.4 in 1.3 s with 150 000), unless they are few anyway (64^3: 40.9 for 41.8 dB).
_MOST_PER_SURFACE, _NOT_TOO_MANY = 1.7, 60_000


class SeedSpacing(Decision):
    """How far from each other are Gaussians seeded?

    In voxels (the shortest edge).
    """

    name = "seed_spacing"
    needs = (SupportLevel,)

    def alternative(self, lab: Lab) -> str:
        """Half as far apart."""
        half = lab.plan.spacing / 2
        return f"{half:.2g}: {2**lab.problem.dimensions} times the Gaussians, twice the pairs"

    def ask(self, known: Known, lab: Lab) -> Answer:
        """As close as the detector can tell apart, as far as that is not too many."""
        problem, settings = lab.problem, lab.settings
        finest, because = finest_spacing(problem)
        most, limit = _most_gaussians(lab)
        crowded = (cells(lab.support, problem) / most) ** (1 / problem.dimensions)
        if crowded <= finest:
            return Answer(finest, because, Status.ASKED, {"most": most, "crowded": 0.0})
        because = f"at most {most} Gaussians{limit} over {lab.support} voxels of support"
        because += f", {settings.finer_seeds:.0%} of them closer where the start varies"
        because += ", thin across its edges" if settings.seed_edge else ""
        return Answer(crowded, because, Status.ASKED, {"most": most, "crowded": 1.0})


def _most_gaussians(lab: Lab) -> tuple[int, str]:
    """How many Gaussians at most, and why not more."""
    problem, settings, start = lab.problem, lab.settings, lab.start
    if settings.max_gaussians or lab.device.type == "cpu":
        return settings.max_gaussians or _MOST_ON_CPU, ""
    views = settings.views_per_step or MOST_VIEWS["cuda"]
    room = _SHARE_OF_SEEDS * room_for_seeds(views, problem, lab.device)
    # Few voxels hold more seeds than one each: rays tell what is inside them.
    worth = min(max(math.prod(start.shape), _NOT_TOO_MANY), most_seeds(problem))
    most = max(round(min(room, worth)), 1)
    told = ", for which there is memory," if room < worth else ""
    if problem.planar:
        return most, told
    # Averaged, as noise would make holes with surfaces of their own. What is dense has surfaces within other matter.
    mean, surface = box_mean(torch.as_tensor(start), np.minimum(3, start.shape)), 0
    for level in (lab.least, settings.bone_level * lab.plan.reference * problem.depth):
        matter = mean > level
        surface += int((matter & widened(~matter, 1)).sum())
    enough = max(_NOT_TOO_MANY, round(_MOST_PER_SURFACE * surface * cells(1, problem) ** (2 / 3)))
    return (most, told) if most <= enough else (enough, f", for {surface} voxels at its surfaces,")
