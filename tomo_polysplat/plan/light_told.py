"""What the residuals of a fit tell of gains and drift, and whether held-out rays confirm it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.residual_sums import ResidualSums
from tomo_polysplat.nuisances.drift import Drift
from tomo_polysplat.nuisances.gain_estimate import drift_of_views, gains_of_pixels
from tomo_polysplat.nuisances.gains import Gains
from tomo_polysplat.nuisances.light_factor import WORTH, LightFactor
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.settings import Settings

__all__ = ["EARLY_LIGHT", "LightTold", "Sums", "ask_gains_again", "ask_light", "light_told", "wanted_light"]

# The fact of a plan that some was taken out before its questions.
EARLY_LIGHT = "early_light"

# Held-out rays that tell anything.
_FEWEST_RAYS = 30
# A third of the views are looked at first, so many at most; fewer than these tell little.
_FIRST, _FEWEST_FIRST = 128, 32
# What the object holds as rings shows bit by bit, as smoothing pulls it out: each time one goes so much farther than is
# seen, before what is no gain is left out. From 1 on what is seen at once would swing from time to time.
_FURTHER = 0.8
_KINDS: tuple[type[LightFactor], ...] = (Drift, Gains)

# Adds up what a fit leaves of some views by their numbers, or of all: `fit.residual_sums` of its parts.
Sums = Callable[[np.ndarray | None], ResidualSums]


@dataclass(frozen=True)
class LightTold:
    """What was told of one kind.

    Attributes
    ----------
    kept : bool
        Whether it is taken out.
    change : array
        What is taken out from now on, less what was before: (views looked at,) of drift, (rows, columns) of gains.
    why : str
    evidence : dict of str to float
        See `nuisances.light_factor.LightFactor.gate`; of drift, ``beside`` as well, as `Drift.told` takes it.
    """

    kept: bool
    change: np.ndarray
    why: str
    evidence: dict[str, float]

    def answer(self, **more: float) -> Answer:
        """For the plan, with ``more`` evidence."""
        told = {name: number for name, number in self.evidence.items() if math.isfinite(number)}
        told |= {name: float(number) for name, number in more.items()}
        return Answer(self.evidence["rms"] if self.kept else 0.0, self.why, Status.ASKED, told)


def wanted_light(settings: Settings) -> dict[str, Any]:
    """By name, what a caller says: False leaves it in, True takes it out unasked, None asks."""
    return {kind.name: getattr(settings, kind.name) for kind in _KINDS}


def ask_light(problem: Problem, sums: Sums, options: Settings, worth: float = WORTH) -> dict[str, LightTold]:
    """By name, what the rays tell: some views first, and all where these show anything.

    A look at all views takes as long as half a pass on a GPU, and a third of one on a CPU.

    Parameters
    ----------
    problem, options
        As `light_told` takes them.
    sums : callable
        See `Sums`.
    worth : float
        What takes away less of the misfit of held-out rays is not looked for in all views.
    """
    views = problem.geometry.views
    first = min(views // 3, _FIRST)
    if first >= _FEWEST_FIRST and not problem.taken.steps and True not in wanted_light(options).values():
        told = light_told(problem, sums(_some(first, views)), options)
        if all(
            kind.ruled_out(told[kind.name].evidence, first / views, worth)
            for kind in _KINDS
            if kind.name in told
        ):
            return told
    return light_told(problem, sums(None), options)


def ask_gains_again(problem: Problem, sums: Sums, options: Settings) -> dict[str, LightTold]:
    """What some views tell of gains that were found before; see `ask_light`."""
    views = problem.geometry.views
    some = _some(_FIRST, views) if views >= 2 * _FIRST else None
    return light_told(problem, sums(some), replace(options, drift=False))


def _some(count: int, views: int) -> np.ndarray:
    """Numbers of so many views, evenly spread around."""
    return np.arange(count) * views // count


def light_told(problem: Problem, sums: ResidualSums, settings: Settings) -> dict[str, LightTold]:
    """By name, drift first, and the gains as they are without it; what a caller wants left in is missing.

    Parameters
    ----------
    problem : Problem
        Tells what was taken out of the rays before: the whole of each is told anew.
    sums : ResidualSums
    settings : Settings
    """
    told, wanted = {}, wanted_light(settings)
    if wanted[Drift.name] is not False:
        taken = problem.taken.drift[sums.views]
        found = drift_of_views(sums.count, sums.by_depth + sums.count * taken[:, None])
        told[Drift.name] = drift = _beside_told(_judged(Drift, found, taken, sums, sums.view, settings), sums)
        sums = sums.without_drift(drift.change)
    if wanted[Gains.name] is not False:
        taken = problem.taken.gains
        times = 1 + _FURTHER if taken.any() else 1.0
        found = gains_of_pixels(sums.weight, times * sums.total + sums.weight * taken, _axis_column(problem))
        told[Gains.name] = _judged(Gains, found, taken, sums, sums.pixel, settings)
    return told


def _judged(
    kind: type[LightFactor],
    found: np.ndarray,
    taken: np.ndarray,
    sums: ResidualSums,
    where: np.ndarray,
    settings: Settings,
) -> LightTold:
    """What was found, as far as held-out rays confirm it."""
    evidence = _evidence(found, taken, sums, where, settings.huber_corner)
    verdict = kind.gate(evidence)
    kept = verdict.kept or (getattr(settings, kind.name) is True and evidence["rms"] > 0)
    return LightTold(kept, found - taken if kept else -taken, verdict.why, evidence)


def _beside_told(drift: LightTold, sums: ResidualSums) -> LightTold:
    """The same, with the share of views in which rays pass beside the object, and words where too few do."""
    beside = {"beside": float((sums.count[..., 0] > 0).any(axis=0).mean())}
    alike = Drift.looks_alike(beside) if drift.kept else ""
    return replace(drift, why="; ".join(filter(None, (drift.why, alike))), evidence=drift.evidence | beside)


def _axis_column(problem: Problem) -> float:
    """Where the axis of rotation is seen, in the mean of the views."""
    seen = problem.geometry.project_points(problem.axis[None])
    return float(np.mean(seen[..., 0]))


def _evidence(
    found: np.ndarray, taken: np.ndarray, sums: ResidualSums, where: np.ndarray, corner: float
) -> dict[str, float]:
    """How much better the held-out rays are explained, each with what was found and without any.

    The misfit is Huber's, with the corner that the fit has (`fit.loss.losses`).
    """
    rays, rms = len(sums.residual), float(np.sqrt(np.mean(found**2)))
    if rays < _FEWEST_RAYS:
        return {"rms": rms, "better": math.nan, "error": math.nan}
    from scipy.special import huber

    without = sums.residual + taken.ravel()[where]
    left = (without, without - found.ravel()[where])
    before, after = (huber(corner, residual / sums.deviation) for residual in left)
    mean = max(float(before.mean()), 1e-300)
    better, error = float((before - after).mean()), float((before - after).std()) / math.sqrt(rays)
    return {"rms": rms, "better": better / mean, "error": error / mean}
