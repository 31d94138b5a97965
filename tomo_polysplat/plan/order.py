"""The order in which a plan's questions are asked, and the loop that asks them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch

from tomo_polysplat.fit.optimise import Run
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known, When
from tomo_polysplat.plan.decisions.agent import Agent
from tomo_polysplat.plan.decisions.closer_seeds import CloserSeeds
from tomo_polysplat.plan.decisions.curves import Curves
from tomo_polysplat.plan.decisions.detector_blur import DetectorBlur
from tomo_polysplat.plan.decisions.edges import Edges
from tomo_polysplat.plan.decisions.finer_seeds import FinerSeeds
from tomo_polysplat.plan.decisions.growth import Growth
from tomo_polysplat.plan.decisions.light import Light
from tomo_polysplat.plan.decisions.optical_depth import OpticalDepth
from tomo_polysplat.plan.decisions.passes import Passes
from tomo_polysplat.plan.decisions.pixel_rays import PixelRays
from tomo_polysplat.plan.decisions.scatter import Scattering
from tomo_polysplat.plan.decisions.seed_spacing import SeedSpacing
from tomo_polysplat.plan.decisions.smallest_scale import SmallestScale
from tomo_polysplat.plan.decisions.soft_reference import SoftReference
from tomo_polysplat.plan.decisions.support_level import SupportLevel
from tomo_polysplat.plan.decisions.tv_corner import TvCorner
from tomo_polysplat.plan.decisions.tv_every import TvEvery
from tomo_polysplat.plan.decisions.tv_factor import TvFactor
from tomo_polysplat.plan.decisions.views_per_step import ViewsPerStep
from tomo_polysplat.plan.lab import Lab, Untold
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.settings import Settings

__all__ = ["ORDER", "alternatives", "answer_to", "ask_between", "decide", "decide_start", "plan_from_start"]

ORDER: tuple[type[Decision], ...] = (
    SoftReference,
    SupportLevel,
    SeedSpacing,
    FinerSeeds,
    SmallestScale,
    Passes,
    ViewsPerStep,
    TvEvery,
    Curves,
    DetectorBlur,
    TvCorner,
    OpticalDepth,
    Agent,
    Edges,
    CloserSeeds,
    Growth,
    TvFactor,
    Scattering,
    PixelRays,
    Light,
)


def decide(lab: Lab, when: When) -> None:
    """Answer what is asked at one time, in `ORDER`, into the plan of the ``lab``.

    During a run only what need not be asked is answered here; `ask_between` asks the rest.
    """
    for decision in _open(lab, when):
        answer = _without_asking(decision, lab) if when is When.DURING else answer_to(decision, lab)
        if answer is not None:
            lab.plan.answers[decision.name] = answer


def answer_to(decision: Decision, lab: Lab) -> Answer:
    """The answer to one question: as given, as usual where it need not or could not be asked, or as the data tell."""
    return _without_asking(decision, lab) or _asked(decision, lab)


def ask_between(lab: Lab, run: Run, order: Sequence[type[Decision]] = ORDER) -> None:
    """Ask what is due between two passes of a run, until an answer has made passes or begins the run anew."""
    lab.run = run
    for decision in _open(lab, When.DURING, order):
        if run.clock.share() >= decision.share and run.made is None and run.restart is None:
            lab.plan.answers[decision.name] = _asked(decision, lab)
    lab.run = None


def plan_from_start(start: torch.Tensor, problem: Problem, settings: Settings, device: torch.device) -> Plan:
    """The plan of a start volume, before any short fit.

    Parameters
    ----------
    start : (nz, ny, nx) tensor
        First reconstruction in the solver's units (`plan.first_volume`).
    problem : Problem
    settings : Settings
    device : torch.device
    """
    lab = Lab(problem, start, settings, device)
    decide_start(lab)
    return lab.plan


def decide_start(lab: Lab) -> None:
    """Answer what the start volume tells, and what the settings say of the run."""
    for decision in _open(lab, When.DURING):
        if (value := decision.given(lab.settings)) is not None:
            lab.plan.answers[decision.name] = _given(value)
    decide(lab, When.START)


def alternatives(lab: Lab) -> dict[str, str]:
    """By the name of a decision, what another choice than that of the plan would cost."""
    told = {kind.name: kind().alternative(lab) for kind in ORDER}
    return {name: words for name, words in told.items() if words}


def _open(lab: Lab, when: When, order: Sequence[type[Decision]] = ORDER) -> Iterator[Decision]:
    for kind in order:
        if kind.when is when and kind.name not in lab.plan.answers:
            yield kind()


def _given(value: Any) -> Answer:
    return Answer(value, "asked for", Status.GIVEN)


def _without_asking(decision: Decision, lab: Lab) -> Answer | None:
    """As the settings say, or as usual where it need not be asked."""
    if (value := decision.given(lab.settings)) is not None:
        return _given(value)
    known = Known(lab.plan, type(decision))
    why = decision.why_not(known, lab)
    return Answer(decision.usual(known, lab), why, Status.USUAL) if why else None


def _asked(decision: Decision, lab: Lab) -> Answer:
    known = Known(lab.plan, type(decision))
    try:
        return decision.ask(known, lab)
    except Untold as why:
        return Answer(decision.usual(known, lab), f"{why}", Status.USUAL)
