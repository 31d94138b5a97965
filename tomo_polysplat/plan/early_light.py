"""Gains and drift taken out before the questions of a run, which would take them for noise and missing detail.

The first fit tells the most of them. The run tells the whole anew, by fits that are better (`plan.steady_light`).
"""

from __future__ import annotations

import logging
from functools import partial
from typing import Any

from tomo_polysplat.fit.residual_sums import residual_sums
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.first_look import Look
from tomo_polysplat.plan.light_told import EARLY_LIGHT, LightTold, ask_light, wanted_light
from tomo_polysplat.settings import Settings

__all__ = ["take_out_early"]

logger = logging.getLogger(__name__)

# Of the misfit of held-out rays: what takes away less changes no question, and is not worth another start. It was 1.0 %
# and more of gains of 0.5 to 4 % and drift of 1.5 %, and up to 0.3 % of what is no gain, on steady scanners.
_WORTH = 0.005


def take_out_early(look: Look, settings: Settings) -> dict[str, Answer]:
    """Take out of the rays what a fit tells and held-out rays confirm, in one step; what is very little stays in.

    Parameters
    ----------
    look : Look
    settings : Settings
        The caller's.

    Returns
    -------
    dict of str to Answer
        Facts for the plan; none where nothing is taken out, and all is as before.
    """
    wanted = wanted_light(settings)
    if all(one is False for one in wanted.values()):
        return {}
    lab = look.lab
    sums = partial(residual_sums, look.gaussians, lab.scene, lab.rays, look.settings)
    told = ask_light(lab.problem, sums, settings, _WORTH)
    for name, one in told.items():
        logger.debug("%s before the questions: %s", name, one.why)
    kept = {name: one for name, one in told.items() if one.kept and _is_worth(one, wanted[name])}
    if not kept:
        return {}
    lab.problem.taken.add(**{name: one.change for name, one in kept.items()})
    lab.problem.forget_told()
    words = "; ".join(f"{name} of {one.why}" for name, one in kept.items())
    logger.info("Taken out before the questions: %s.", words)
    early = Answer({name: one.evidence["rms"] for name, one in kept.items()}, words, Status.ASKED)
    return {name: one.answer(asked=0) for name, one in kept.items()} | {EARLY_LIGHT: early}


def _is_worth(told: LightTold, wanted: Any) -> bool:
    """Whether it is taken out before the questions: the run tells the rest."""
    return wanted is True or told.evidence["better"] > _WORTH
