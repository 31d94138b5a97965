"""Whether a fit has come to more than it began with, by rays that it has not seen; if not, its start is the result."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

import torch

from tomo_polysplat.fit.misses import Misses, misses
from tomo_polysplat.fit.optimise import FitOutcome
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import is_number
from tomo_polysplat.plan.model import scene_of
from tomo_polysplat.plan.one_energy import doubt_spectrum
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.plan.preparation import PreparedFit, RunOptions

__all__ = ["densities_of_start", "judge", "note_seeds"]

logger = logging.getLogger(__name__)

# Seeds are blurred, and a volume of them is 3 to 4 dB worse than the start that they are made of. A run that is cut
# short has regained that where it leaves less than this share of the misfit that noise does not explain. Five scenes of
# 32^3, of 1 to 90 steps, in dB without metal over the start: with 0.8 to 1.1 of it -0.9 to -3.8, with 0.6 -0.9 and
# +3.2, with 0.5 -3.1, +0.5 and +1.2, with 0.2 to 0.4 +0.7 to +9.
_REGAINED = 0.5
# Over the root of the number of rays: by how much more the end of a whole run has to leave than its start.
_CHANCE = 3.0
# Rays that are missed by so many times their noise and the model's allowed error together are told as a warning. Whole
# runs of 26^3 and 32^3 come to 0.9 to 1.9, also with a spectrum that is wrong, and to 15 with an axis 2 pixels off.
# Circuit boards and connectors, whose metal is thinner than voxels, come to 5 to 6 where all is right.
_FAR = 4.0
_NO_SPECTRUM = (
    "no spectrum was given, so the model has one energy: pass spectrum= (--kvp, --filter, --detector)"
)
_THIN_METAL = (
    " Metal thinner than a voxel leaves as much: smaller voxels, where the pixels are smaller, tell."
)


def note_seeds(prepared: PreparedFit, problem: Problem, run_options: RunOptions) -> None:
    """Keep in the plan how the first Gaussians miss the rays, and whether those of one energy miss them by less.

    A checkpoint's plan knows it already; a time budget is too precious for the second question.
    """
    plan = prepared.plan
    if not len(prepared.gaussians) or "rays_at_start" in plan.facts:
        return
    found = _misses(prepared.gaussians, prepared, problem, run_options)
    plan.note("rays_at_start", found.misfit, f"misfit of the first Gaussians; {found.describe()}")
    doubt = None
    if run_options.time_budget is None:
        doubt = doubt_spectrum(problem, found.misfit, run_options)
    if doubt is not None:
        plan.facts["spectrum_doubt"] = doubt


def judge(outcome: FitOutcome, prepared: PreparedFit, problem: Problem, run_options: RunOptions) -> bool:
    """Tell how the rays are missed, in the plan, and in the log where by much; whether the start is the better one."""
    if not len(outcome.gaussians):
        return False
    plan = prepared.plan
    # By what was answered during the run as well.
    scene = scene_of(problem, plan, run_options.settings, run_options.device)
    found = _misses(outcome.gaussians, replace(prepared, scene=scene), problem, run_options)
    first = plan.facts["rays_at_start"].value if "rays_at_start" in plan.facts else math.inf
    left = _left(found, first if is_number(first, 0.0) else math.inf)
    words = f"{found.describe()}, and {f'{left:.2g}' if left else 'nothing'} of the first Gaussians' misfit is left"
    if far := found.allowed > _FAR:
        words += f"; that is {found.allowed:.2g} times what noise and the model's usual error come to"
        spectrum = (
            _NO_SPECTRUM
            if problem.spectrum is None
            else "is the spectrum that of this scan, with its filters"
        )
        logger.warning(
            "The rays are not explained: %s. Ask `tomo-polysplat check` about axis and detector; %s,"
            " and is all of the object inside the volume?%s",
            words,
            spectrum,
            _THIN_METAL if bool((outcome.gaussians.group > 0).any()) else "",
        )
    evidence = {"allowed": found.allowed, "left": left if math.isfinite(left) else 0.0, "rays": found.rays}
    value = found.allowed if math.isinf(found.times) else found.times
    plan.facts["rays"] = Answer(value, words, Status.FOUND, evidence | {"far": float(far)})
    assert outcome.stop is not None
    if outcome.stop.by_time:
        return left > _REGAINED
    # Where the seeds leave little but noise, the share of the rest says nothing.
    return is_number(first, 0.0) and found.misfit > first * (1.0 + _CHANCE / math.sqrt(max(found.rays, 1)))


def densities_of_start(
    start: torch.Tensor, plan: Plan, problem: Problem, reference_curve: torch.Tensor | None
) -> torch.Tensor:
    """(channels, nz, ny, nx) densities of the curves, as `Result` has them, of a start volume.

    All matter is taken for what the soft reference is, as the start itself does; none is below zero.
    """
    density = start.clamp(min=0.0) / problem.depth
    if plan.curves == 1 or reference_curve is None:
        return density[None]
    number = plan.soft_u
    shares = density.new_tensor([(1 - number) ** 2, 2 * number * (1 - number), number**2])
    return shares[:, None, None, None] / (reference_curve.to(density) @ shares) * density


def _left(found: Misses, first: float) -> float:
    """Share of the first Gaussians' misfit that is left, of what noise does not explain."""
    excess = first - found.least
    if excess <= 0 or math.isinf(first):
        return 0.0
    return found.excess / excess


def _misses(gaussians: Gaussians, prepared: PreparedFit, problem: Problem, run_options: RunOptions) -> Misses:
    noise = problem.noise(run_options.device)
    return misses(gaussians, prepared.scene, prepared.rays, noise, run_options.settings)
