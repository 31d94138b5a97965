"""Gains and drift taken out before the questions of a run, which would take them for noise and missing detail.

A fit of a pass, which the look for moves of the scanner has made, tells the most of them. The run tells the whole
anew, by fits that are better (`plan.steady_light`).
"""

from __future__ import annotations

import logging
from dataclasses import replace

import torch

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.residual_sums import residual_sums
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.light_told import EARLY_LIGHT, light_told, wanted_light
from tomo_polysplat.plan.model import rays_of, scene_of
from tomo_polysplat.plan.realignment import Look
from tomo_polysplat.settings import Settings

__all__ = ["take_out_early"]

logger = logging.getLogger(__name__)

# Rays held out that are enough to tell: of a large scan fewer are than were of the fit.
_RAYS = 1e6


def take_out_early(
    problem: Problem, look: Look, settings: Settings, device: torch.device
) -> dict[str, Answer]:
    """Take out of the rays what a fit tells and held-out rays confirm, in one step.

    Parameters
    ----------
    problem : Problem
        By the scanner as it stood.
    look : Look
    settings : Settings
        The caller's.
    device : torch.device

    Returns
    -------
    dict of str to Answer
        Facts for the plan; none where nothing is taken out, and all is as before.
    """
    if all(wanted is False for wanted in wanted_light(settings).values()) or not len(look.gaussians):
        return {}
    share = min(look.settings.held_out, max(settings.held_out, _RAYS / problem.projections.size))
    asking, plan = replace(look.settings, held_out=share), look.plan.assuming()
    scene, rays = scene_of(problem, plan, asking, device), rays_of(problem, plan, asking, device)
    told = light_told(problem, residual_sums(look.gaussians, scene, rays, asking), asking)
    for name, one in told.items():
        logger.debug("%s before the questions: %s", name, one.why)
    kept = {name: one for name, one in told.items() if one.kept}
    if not kept:
        return {}
    problem.taken.add(**{name: one.change for name, one in kept.items()})
    problem.forget_told()
    words = "; ".join(f"{name} of {one.why}" for name, one in kept.items())
    logger.info("Taken out before the questions: %s.", words)
    early = Answer({name: one.evidence["rms"] for name, one in kept.items()}, words, Status.ASKED)
    return {name: one.answer(asked=0) for name, one in kept.items()} | {EARLY_LIGHT: early}
