"""The physics that a calibration tries: what it changes, where a short fit says that is, and which fit is taken."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.physics.ray_estimates import estimate_scatter, matching_factor
from tomo_polysplat.physics.scatter import Scatter
from tomo_polysplat.physics.spectral_change import tube_voltage, with_filtration, with_voltage
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.tube_tables import voltage_range
from tomo_polysplat.plan.short_fit import ShortFit

__all__ = [
    *("CHANGES", "LEAST_SCATTER", "bounds_of", "describe_scatter", "judge_scatter"),
    *("moved_scatter", "moved_spectrum", "with_fitted"),
]

# Scatter below this share of the open beam, and densities closer than this, are left as they are.
LEAST_SCATTER, _LEAST_CHANGE = 2e-3, 0.02
# Held-out errors of two fits of the same scan under nearly the same physics, with one seed, differ by up to 2 %.
_MARGIN = 0.03
# Scatter, and a brighter beam, have to explain the darkest rays by so much better than each other. Scatter of 1 and 2 %
# in scenes with metal did by 8 to 36 %; beams 1 % brighter are taken for scatter where iron is opaque (10 and 12 %).
_DARKER = 0.05
# Scatter adds to every ray. So many rays, and such a share of them, may be darker than it by some fault of theirs.
_FEW_DARKER, _DARKER_SHARE = 7, 1.5e-4
# With so small a share of the other's held-out error the darkest rays need not tell: they are few, and a short fit of
# metal is rough (bronze at 220 kV, 3 % of scatter: 0.42; beams 1 % brighter, taken for scatter: 0.90).
_FAR_BETTER = 0.7
# Factors of the tube voltage and of the filters that are looked at.
_BOUNDS = {"kvp": (0.8, 1.25), "filter": (0.4, 2.5)}
CHANGES: dict[str, Callable[[Spectrum, float], Spectrum]] = {"kvp": with_voltage, "filter": with_filtration}


def with_fitted(problem: Problem, fitted: Mapping[str, float]) -> Problem:
    """The problem under other physics.

    Parameters
    ----------
    problem : Problem
        Polychromatic.
    fitted : mapping
        ``scatter`` and ``scatter_of_light`` (the attributes of `Scatter`), ``beam`` (its brightness, in those of the
        open field), and factors ``kvp`` and ``filter`` of the spectrum, as far as they differ.
    """
    spectrum = problem.spectrum
    assert spectrum is not None
    for name, change in CHANGES.items():
        if fitted.get(name, 1.0) != 1.0:
            spectrum = change(spectrum, fitted[name])
    return problem.under(spectrum, _scatter_in(fitted), float(fitted.get("beam", 1.0)))


def describe_scatter(fitted: Mapping[str, float]) -> str:
    """In words; `with_fitted` tells what is in ``fitted``."""
    if "beam" in fitted:
        return f"a beam {fitted['beam']:.4g} times as bright as the open field"
    scatter = _scatter_in(fitted)
    words = f"{scatter.constant:.4g} of the open beam"
    return words + (f" and {scatter.of_light:.4g} of the light around a ray" if scatter.varies else "")


def _scatter_in(fitted: Mapping[str, float]) -> Scatter:
    return Scatter(float(fitted.get("scatter", 0.0)), float(fitted.get("scatter_of_light", 0.0)))


def _as_fitted(scatter: Scatter) -> dict[str, float]:
    """As `with_fitted` takes it."""
    return {"scatter": scatter.constant} | ({"scatter_of_light": scatter.of_light} if scatter.varies else {})


def moved_scatter(last: ShortFit, problem: Problem) -> dict[str, float]:
    """The scatter where the last short fit says that it is; nothing where that is where it was."""
    physics, rays = with_fitted(problem, last.fitted), last.rays
    assert physics.spectrum is not None and physics.materials is not None
    if not len(rays.light):
        return {}
    level, was = last.scatter_level, physics.scatter
    sample = (rays.areal, rays.measured, rays.weight, rays.light)
    found = estimate_scatter(*sample, physics.spectrum, physics.materials, level)
    new = Scatter(was.constant + found.constant - level, was.of_light + found.of_light)
    light = torch.as_tensor(rays.light)
    old, now = was.at(light), new.at(light)
    if float((now - old).abs().max()) <= max(LEAST_SCATTER, 0.02 * float(old.max())):
        return {}
    return _as_fitted(new)


def moved_spectrum(name: str, last: ShortFit, soft_density: float, problem: Problem) -> dict[str, float]:
    """The factor of the spectrum under which the main matter has its density; nothing where it has it."""
    physics, old = with_fitted(problem, last.fitted), last.fitted.get(name, 1.0)
    assert physics.spectrum is not None and physics.materials is not None
    ratio = soft_density / last.soft_density if last.soft_density else 1.0
    if abs(ratio - 1.0) < _LEAST_CHANGE:
        return {}
    low, high = bounds_of(name, problem)
    longest, bounds = float(np.quantile(last.rays.areal[0], 0.95)), (low / old, high / old)
    change, soft = CHANGES[name], physics.materials.soft
    value = old * matching_factor(change, physics.spectrum, soft, longest, ratio, bounds)
    return {} if value == old else {name: value}


def bounds_of(name: str, problem: Problem) -> tuple[float, float]:
    """Range of a factor of the assumed spectrum; voltages end where the tables of tubes do."""
    low, high = _BOUNDS[name]
    if name != "kvp":
        return low, high
    assert problem.spectrum is not None
    # A hair inside: dividing and multiplying by a factor rounds.
    first, last = (end / tube_voltage(problem.spectrum) for end in voltage_range("W"))
    return max(low, first * (1 + 1e-9)), min(high, last * (1 - 1e-9))


def judge_scatter(
    before: ShortFit, stage: Sequence[ShortFit], suspected: bool
) -> tuple[ShortFit | None, str]:
    """The best of the fits with scatter, or with a brighter beam, where the rays tell that it is."""
    kinds = [[fit for fit in stage if name in fit.fitted] for name in ("scatter", "beam")]
    best = [min(fits, key=lambda fit: fit.held_out) for fits in kinds if fits]
    not_taken = []
    if suspected and best and "scatter" in best[0].fitted:
        darker = before.rays.darker_than(_scatter_in(best[0].fitted))
        if darker > max(_FEW_DARKER, _DARKER_SHARE * len(before.rays.measured)):
            words = describe_scatter(best.pop(0).fitted)
            not_taken.append(
                f"{words}, not accepted: {darker} of {len(before.rays.measured)} rays have less light"
            )
    for fit in best:
        against = _against(fit, before, [rival for rival in best if rival is not fit], suspected)
        errors = f"held-out error {before.held_out:.3e} before, {fit.held_out:.3e} after"
        errors += f", of the darkest rays {before.darkest:.3e} and {fit.darkest:.3e}"
        if not against:
            return fit, f"{describe_scatter(fit.fitted)}, accepted: {errors}"
        not_taken.append(f"{describe_scatter(fit.fitted)}, not accepted, as {against}: {errors}")
    return None, "; ".join(not_taken)


def _against(fit: ShortFit, before: ShortFit, rivals: Sequence[ShortFit], suspected: bool) -> str:
    """What speaks against a fit in words, or nothing."""
    if not fit.held_out < (1 - _MARGIN) * before.held_out:
        return f"the held-out rays do not fit {_MARGIN:.0%} better"
    if suspected and not fit.darkest < before.darkest * (1.0 if "scatter" in fit.fitted else 1 + _MARGIN):
        return "the darkest rays fit no better"
    if suspected and not all(_as_good(fit, rival) for rival in rivals):
        other = "a brighter beam" if "scatter" in fit.fitted else "scatter"
        return f"it explains the rays no better than {other}"
    return ""


def _as_good(fit: ShortFit, rival: ShortFit) -> bool:
    """Whether a fit explains the rays as well as another, and the darkest better, or all of them far better."""
    if fit.held_out < _FAR_BETTER * rival.held_out:
        return fit.darkest <= rival.darkest
    return fit.held_out < (1 + _MARGIN) * rival.held_out and fit.darkest < (1 - _DARKER) * rival.darkest
