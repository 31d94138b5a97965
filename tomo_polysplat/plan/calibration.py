"""Finding what is wrong with the assumed physics before the fit: scatter, and a tube's voltage or filters.

Short fits say how a change of the physics fits the rays that were held out, and the darkest ones. Scatter shows in air
and behind metal, so the rays alone tell it. A tube voltage does not show in them: its change by 10 % scales the object
and leaves the rest of a fitted volume within half a per cent (``docs/spectrum.md``). What tells it is the density of
the object's main matter, where that is known.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from tomo_polysplat.checks import fail, require_choice, require_number
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.kernels.compile_time import working_time
from tomo_polysplat.nuisances.known import SPECTRAL
from tomo_polysplat.nuisances.open_beam import LEAST_BRIGHTER
from tomo_polysplat.physics.spectral_change import tube_voltage
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.plan.calibrated_physics import (
    judge_factor,
    judge_scatter,
    moved_factor,
    moved_scatter,
    scatter_beside,
    with_fitted,
)
from tomo_polysplat.plan.first_volume import first_volume
from tomo_polysplat.plan.fit_options import FitOptions
from tomo_polysplat.plan.lab import Untold
from tomo_polysplat.plan.short_fit import ShortFit, short_fit
from tomo_polysplat.plan.trial import TOO_SHORT
from tomo_polysplat.settings import Settings

__all__ = ["Calibration", "calibrated"]

logger = logging.getLogger(__name__)

_ROUNDS = 2
# Of the seconds that a reconstruction may take, the share for all short fits with their start volumes.
_SHARE_OF_BUDGET = 0.6
# Steps of a short fit that tells a density: it is 0.7 to 1.5 % low after 120 (teeth, pins, lung), 0.3 to 0.5 after 240.
_STEPS_FOR_DENSITY = 240
# Share of the rays that is held out of them, and looked at after them: a slice of 1152 rays holds seven out of its run.
_HELD_OUT = 0.1
# Nothing is denser, in g/cm3.
_DENSEST = 25.0

Record = dict[str, Any]


@dataclass(frozen=True)
class Calibration:
    """What to calibrate.

    Attributes
    ----------
    names : tuple of str
        Among ``"scatter"``, ``"kvp"`` and ``"filter"``.
    soft_density : float or None
        Density in g/cm3 of the object's main matter, as far as it is made of the first material.
    suspected : bool
        Whether the rays alone ask for it. Then scatter has to explain the darkest of them as well, and better than a
        beam that is brighter than its open field, which looks alike beside the object, and may be found instead.
    """

    names: tuple[str, ...]
    soft_density: float | None
    suspected: bool = False

    @classmethod
    def of(
        cls,
        calibrate: bool | str | Sequence[str] | None,
        soft_density: float | None,
        spectrum: Spectrum | None,
    ) -> Calibration | None:
        """What a caller asks for, checked; None for nothing."""
        if not calibrate:
            if soft_density is not None:
                raise fail(
                    "soft_density", "calibrate beside it", "none", "pass calibrate=True (--calibrate) as well"
                )
            return None
        if spectrum is None:
            raise fail("calibrate", "a spectrum to calibrate", "none")
        if soft_density is not None:
            remedy = "in g/cm3: divide by 1000 what is in kg/m3"
            soft_density = require_number(
                "soft_density", soft_density, above=0.0, at_most=_DENSEST, remedy=remedy
            )
        if isinstance(calibrate, (bool, np.bool_)):
            names: tuple[str, ...] = ("scatter",) if soft_density is None else ("scatter", "kvp")
        else:
            if not isinstance(calibrate, (str, Sequence)):
                raise fail("calibrate", "True, False or names", repr(calibrate), error=TypeError)
            names = (calibrate,) if isinstance(calibrate, str) else tuple(calibrate)
        for name in names:
            require_choice("calibrate", name, ("scatter", *SPECTRAL))
        return cls(names, soft_density)._checked(spectrum)

    def _checked(self, spectrum: Spectrum) -> Calibration:
        spectral = [name for name in self.names if name in SPECTRAL]
        if len(spectral) > 1:
            raise fail("calibrate", "'kvp' or 'filter'", "both", "one known density tells one of them")
        if spectral and self.soft_density is None:
            remedy = (
                "pass soft_density=, the g/cm3 of the object's main matter: the rays alone do not tell it"
            )
            raise fail("calibrate", f"a known density for {spectral[0]!r}", "none", remedy)
        if spectral:
            tube_voltage(spectrum)
        return self


def calibrated(
    problem: Problem,
    wanted: Calibration,
    settings: Settings,
    device: torch.device,
    seed: int,
    time_budget: float | None,
) -> Record:
    """Fit the physics by a few short fits.

    Parameters
    ----------
    problem : Problem
        Polychromatic.
    wanted : Calibration
    settings : Settings
        Of the fit to come.
    device : torch.device
    seed : int
    time_budget : float or None
        Seconds of the whole reconstruction.

    Returns
    -------
    dict
        JSON-able. ``fitted``: what :func:`with_fitted` takes, only what was accepted; ``accepted``: by name;
        ``held_out_before`` and ``held_out_after``; ``trials``: every short fit; ``why`` in words.
    """

    trials = _Trials(problem, wanted, settings, device, seed, time_budget)
    first = best = trials.made_under({})
    accepted, why = {}, []
    for name in sorted(wanted.names, key=lambda name: name != "scatter"):
        try:
            trials.require_time()
            stage = _stage(name, best, wanted, problem, trials.another)
            chosen, reason = _judge(name, best, stage, problem, wanted)
        except Untold as untold:
            chosen, reason = None, f"not accepted: {untold}"
        accepted[name], best = chosen is not None, chosen or best
        why.append(f"{name}: {reason}")
    logger.info("Calibration: %s", "; ".join(why))
    return {
        "fitted": best.fitted,
        "accepted": accepted,
        "held_out_before": first.held_out,
        "held_out_after": best.held_out,
        "trials": [one.record() for one in trials.made],
        "why": "; ".join(why),
    }


@dataclass
class _Trials:
    """Short fits under one physics after another, for as long as the time budget has room for them."""

    problem: Problem
    wanted: Calibration
    settings: Settings
    device: torch.device
    seed: int
    budget: float | None
    begun: float = field(default_factory=working_time)
    made: list[ShortFit] = field(default_factory=list)

    def made_under(self, fitted: Mapping[str, float]) -> ShortFit:
        """A short fit, cut or not."""
        physics, settings, device = with_fitted(self.problem, fitted), self.settings, self.device
        start, _ = first_volume(physics, device, settings)
        density = self.wanted.soft_density is not None
        options = FitOptions(settings, self.budget, self.seed, device)
        told: dict[str, Any] = {"density": density, "held_out": _HELD_OUT}
        if density:
            told["fewest_steps"] = _STEPS_FOR_DENSITY
        self.made.append(short_fit(physics, start, dict(fitted), options, **told))
        return self.made[-1]

    def another(self, fitted: Mapping[str, float]) -> ShortFit:
        """A short fit that the time budget leaves room for.

        Raises
        ------
        Untold
            If there is none.
        """
        self.require_time()
        one = self.made_under(fitted)
        if one.cut:
            raise Untold(TOO_SHORT)
        return one

    def require_time(self) -> None:
        """See to it that no short fit so far was cut, and that one more, as long as they were, can be made."""
        if self.budget is None:
            return
        spent, number = working_time() - self.begun, len(self.made)
        if self.made[-1].cut or spent * (number + 1) / number > _SHARE_OF_BUDGET * self.budget:
            raise Untold(TOO_SHORT)


def _stage(
    name: str,
    begin: ShortFit,
    wanted: Calibration,
    problem: Problem,
    trial: Callable[[Mapping[str, float]], ShortFit],
) -> list[ShortFit]:
    """Short fits with one quantity moved to where the last of them says that it is."""
    if name == "scatter":
        return _stage_of_scatter(begin, wanted, problem, trial)
    made: list[ShortFit] = []
    for _ in range(_ROUNDS):
        last = made[-1] if made else begin
        assert wanted.soft_density is not None
        moved = moved_factor(name, last, wanted.soft_density, problem)
        if not moved:
            break
        made.append(trial({k: v for k, v in last.fitted.items() if k != name} | moved))
    return made


def _stage_of_scatter(
    begin: ShortFit, wanted: Calibration, problem: Problem, trial: Callable[[Mapping[str, float]], ShortFit]
) -> list[ShortFit]:
    """Short fits with scatter as air shows it, and as all rays do, and moved to where each of these says that it is."""
    others = {name: value for name, value in begin.fitted.items() if not name.startswith("scatter")}
    made: list[ShortFit] = []
    if moved := moved_scatter(begin, problem):
        # Matter that has taken up the scatter behind it hides a part of it, or shows more elsewhere; air does not.
        made = [trial(others | found) for found in (scatter_beside(begin), *moved) if found]
        better = sorted((fit for fit in made if fit.held_out < begin.held_out), key=lambda fit: fit.held_out)
        for fit in better:
            # All go on alone; the best with another beam as well, where it shows one.
            places = moved_scatter(fit, problem)
            made += [trial(others | found) for found in (places if fit is better[0] else places[:1])]
    beam = begin.rays.beam()
    if wanted.suspected and beam - 1.0 > LEAST_BRIGHTER:
        made.append(trial({**begin.fitted, "beam": beam}))
    return made


def _judge(
    name: str, before: ShortFit, stage: Sequence[ShortFit], problem: Problem, wanted: Calibration
) -> tuple[ShortFit | None, str]:
    """Which of a stage's fits is taken, if any, and why."""
    if not stage and name != "scatter" and before.soft_density == 0:
        return None, "too little of the main matter lies inside of it to show its density"
    if not stage:
        return None, "nothing to change"
    if name == "scatter":
        return judge_scatter(before, stage, wanted.suspected)
    return judge_factor(name, before, stage[-1], problem)
