"""The physics that a calibration tries: where a short fit says that it is, and which fit is taken.

What each nuisance is, and its gate, is in `nuisances`; here they meet the problem and the short fits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.nuisances.known import SPECTRAL
from tomo_polysplat.nuisances.light_gate import more_likely
from tomo_polysplat.nuisances.nuisance import Nuisance
from tomo_polysplat.nuisances.open_beam import OpenBeam
from tomo_polysplat.nuisances.scatter import ScatteredLight
from tomo_polysplat.physics.scatter import LARGEST_SCATTER, Scatter
from tomo_polysplat.plan.short_fit import ShortFit

__all__ = [
    "describe_scatter",
    "judge_factor",
    "judge_scatter",
    "moved_factor",
    "moved_scatter",
    "scatter_beside",
    "with_fitted",
]

# Light beside the object is more than the open field by so many deviations at least.
_DEVIATIONS = 3.0


def with_fitted(problem: Problem, fitted: Mapping[str, float]) -> Problem:
    """The problem under other physics.

    Parameters
    ----------
    problem : Problem
        Polychromatic.
    fitted : mapping
        Parameters of nuisances by name, as far as they are not at their start.
    """
    spectrum = problem.spectrum
    assert spectrum is not None
    for name, kind in SPECTRAL.items():
        if fitted.get(name, 1.0) != 1.0:
            spectrum = kind.change(spectrum, fitted[name])
    return problem.under(spectrum, ScatteredLight.of(fitted), float(fitted.get("beam", 1.0)))


def describe_scatter(fitted: Mapping[str, float]) -> str:
    """In words; `with_fitted` tells what is in ``fitted``."""
    kinds = [kind.describe(fitted) for kind in (ScatteredLight, OpenBeam) if kind.name in fitted]
    return ", and ".join(kinds)


def scatter_beside(first: ShortFit) -> dict[str, float]:
    """As much scatter everywhere as rays beside the object show; nothing where noise explains it."""
    level, error = first.rays.beam() - 1.0, first.rays.beam_error()
    return {"scatter": min(level, LARGEST_SCATTER)} if level > _DEVIATIONS * error else {}


def moved_scatter(last: ShortFit, problem: Problem) -> list[dict[str, float]]:
    """The scatter where the last short fit says that it is, alone and with another beam; none where it was there."""
    physics, rays = with_fitted(problem, last.fitted), last.rays
    assert physics.spectrum is not None and physics.materials is not None
    if not len(rays.light):
        return []
    model = (physics.spectrum, physics.materials)
    places = ScatteredLight.moved(physics.scatter, last.scatter_level, rays.fitted, *model)
    beams = [physics.beam * place.pop("beam", 1.0) for place in places]
    return [place | ({} if beam == 1.0 else {"beam": beam}) for place, beam in zip(places, beams)]


def moved_factor(name: str, last: ShortFit, soft_density: float, problem: Problem) -> dict[str, float]:
    """The factor of the spectrum under which the main matter has its density; nothing where it has it."""
    physics = with_fitted(problem, last.fitted)
    assert physics.spectrum is not None and physics.materials is not None and problem.spectrum is not None
    ratio = soft_density / last.soft_density if last.soft_density else 1.0
    longest = float(np.quantile(last.rays.areal[0], 0.95))
    model = (physics.spectrum, physics.materials.soft, problem.spectrum)
    return SPECTRAL[name].moved(last.fitted.get(name, 1.0), ratio, longest, *model)


def judge_factor(
    name: str, before: ShortFit, after: ShortFit, problem: Problem
) -> tuple[ShortFit | None, str]:
    """The fit with a factor of the spectrum, where its gate keeps it, and why."""
    assert problem.spectrum is not None
    low, high = SPECTRAL[name].bounds(problem.spectrum)
    evidence = {"factor": after.fitted[name], "least": low, "most": high} | _errors(before, after)
    verdict = SPECTRAL[name].gate(evidence)
    return after if verdict.kept else None, verdict.why


def judge_scatter(
    before: ShortFit, stage: Sequence[ShortFit], suspected: bool
) -> tuple[ShortFit | None, str]:
    """The best of the fits with scatter, with another beam, or with both, where the rays tell that it is."""
    both = [fit for fit in stage if {"scatter", "beam"} <= fit.fitted.keys()]
    alone = [fit for fit in stage if not {"scatter", "beam"} <= fit.fitted.keys()]
    chosen, why = _one_of_both(before, alone, suspected) if alone else (None, "")
    if not both:
        return chosen, why
    # What has two explanations has to explain more than the best that has one, or none.
    fit, rival = (min(fits, key=lambda fit: fit.held_out) for fits in (both, [before, *alone]))
    share = rival.share_of_darkest(_scatter_seen(rival, fit))
    verdict = ScatteredLight.gate(_evidence(rival, fit, suspected, share, []))
    words = describe_scatter(fit.fitted)
    if verdict.kept:
        return fit, f"{words}, accepted: {_in_words(rival, fit)}"
    refused = f"{words}, not accepted, as {verdict.why}: {_in_words(rival, fit)}"
    return chosen, why if chosen is not None else "; ".join(filter(None, [why, refused]))


def _one_of_both(before: ShortFit, stage: Sequence[ShortFit], suspected: bool) -> tuple[ShortFit | None, str]:
    """Which is taken of scatter and another beam, if any, and why."""
    kinds = [[fit for fit in stage if name in fit.fitted] for name in ("scatter", "beam")]
    best = [min(fits, key=lambda fit: fit.held_out) for fits in kinds if fits]
    share = max(before.share_of_darkest(ScatteredLight.of(fit.fitted)) for fit in best)
    # The rays beside the object show the beam that looks alike. Where it is the open field, that is the fit without.
    bright = any("beam" in fit.fitted for fit in best)
    rivals, not_taken = list(best) if bright else [*best, before], []
    for fit in best:
        evidence = _evidence(before, fit, suspected, share, [rival for rival in rivals if rival is not fit])
        verdict = _kind(fit).gate(evidence)
        if verdict.kept:
            return fit, f"{describe_scatter(fit.fitted)}, accepted: {_in_words(before, fit)}"
        words = f"{describe_scatter(fit.fitted)}, not accepted, as {verdict.why}"
        not_taken.append(f"{words}: {_in_words(before, fit)}")
        if not ScatteredLight.possible(evidence):
            rivals.remove(fit)
    likelier = _likelier(before, rivals, share) if suspected and bright else None
    if likelier is not None:
        return likelier, f"{describe_scatter(likelier.fitted)}, the likelier: {_in_words(before, likelier)}"
    return None, "; ".join(not_taken)


def _likelier(before: ShortFit, fits: Sequence[ShortFit], share: float) -> ShortFit | None:
    """What is taken of scatter and a brighter beam where neither beats the other; None where none beats neither."""
    alone = [_evidence(before, fit, True, share, []) for fit in fits]
    kept = [fit for fit, evidence in zip(fits, alone) if _kind(fit).gate(evidence).kept]
    if len(fits) == 2 and any("beam" in fit.fitted for fit in kept):
        likely = more_likely(*alone)
        return next(fit for fit in fits if likely in fit.fitted)
    return kept[0] if kept else None


def _kind(fit: ShortFit) -> type[Nuisance]:
    return ScatteredLight if "scatter" in fit.fitted else OpenBeam


def _scatter_seen(before: ShortFit, fit: ShortFit) -> Scatter:
    """The scatter of a fit, as a fraction of the beam that the fit before it assumed."""
    scatter = ScatteredLight.of(fit.fitted)
    ratio = fit.fitted.get("beam", 1.0) / before.fitted.get("beam", 1.0)
    return replace(scatter, constant=scatter.constant * ratio)


def _in_words(before: ShortFit, fit: ShortFit) -> str:
    errors = f"held-out error {before.held_out:.3e} before, {fit.held_out:.3e} after"
    return f"{errors}, of the darkest rays {before.darkest:.3e} and {fit.darkest:.3e}"


def _errors(before: ShortFit, fit: ShortFit) -> dict[str, float]:
    """What every gate asks for."""
    return {"held_out_before": before.held_out, "held_out_after": fit.held_out}


def _evidence(
    before: ShortFit, fit: ShortFit, suspected: bool, share: float, rivals: Sequence[ShortFit]
) -> dict[str, float]:
    """What a gate asks for; where nobody has told of scatter, the darkest rays and a fit by what looks alike, too.

    ``share`` is how much of the light of the darkest rays would be scatter.
    """
    numbers = _errors(before, fit)
    if not suspected:
        return numbers
    numbers |= {"darkest_before": before.darkest, "darkest_after": fit.darkest}
    numbers |= {"darkest_rays": float(len(before.darkest_rays)), "darkest_share": share}
    if "scatter" in fit.fitted:
        darker = before.rays.darker_than(_scatter_seen(before, fit))
        numbers |= {"darker": darker, "rays": len(before.rays.measured)}
        numbers |= {"of_light": float(fit.fitted.get("scatter_of_light", 0.0))}
    for rival in rivals:
        numbers |= {"held_out_rival": rival.held_out, "darkest_rival": rival.darkest}
    return numbers
