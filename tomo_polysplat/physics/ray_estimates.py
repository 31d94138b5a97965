"""What rays of known areal densities tell about scatter and spectrum."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.beer_lambert import projection, shares
from tomo_polysplat.physics.materials import MaterialLike, mass_attenuation
from tomo_polysplat.physics.scatter import LARGEST_SCATTER, Scatter
from tomo_polysplat.physics.spectrum import Spectrum

__all__ = ["FittedRays", "estimate_scatter", "matching_factor", "misfit_left"]

_GAUSS_NEWTON_STEPS = 8
# Scatter varies where that leaves so much less of the squared residuals: of constant one chance takes 0.2 % at most.
_BETTER = 0.01
# Where the light around the rays differs by less, no other scatter than a constant one is told.
_LEAST_SPREAD = 0.03
# Residuals count absolutely beyond this many deviations (Huber 1964, doi:10.1214/aoms/1177703732).
_HUBER_CORNER = 1.345
_DEVIATION = 1.4826  # standard deviation of a normal distribution over its median absolute deviation


class FittedRays(NamedTuple):
    """What a fit makes of some rays, beside what was measured.

    Attributes
    ----------
    areal : (curves, rays) array
        Areal densities in g/cm2, of the first curve alone or of all.
    measured, weight : (rays,) arrays
        ``-log(I / I0)``, and what residuals are multiplied with.
    light : (rays,) array
        See `tomo_polysplat.physics.scatter.light_around`.
    """

    areal: np.ndarray
    measured: np.ndarray
    weight: np.ndarray
    light: np.ndarray


def estimate_scatter(
    sample: FittedRays, spectrum: Spectrum | None, materials: Materials | None, start: float = 0.0
) -> Scatter:
    """Scatter that explains the residuals of rays, at least one, best; it varies where that is needed.

    Gauss-Newton steps with Huber's weights on the scatter together with one factor for the amount of each of
    the curves, so that matter which has taken up some of the scatter gives it back.

    Parameters
    ----------
    sample : FittedRays
        Of a fit that assumed ``start``.
    spectrum, materials : Spectrum, Materials, or None
        None where the areal densities of the one curve are -log(I / I0) themselves.
    start : float
        Constant scatter, as a fraction of the open beam.
    """
    rays, light = _rays(sample, spectrum, materials), sample.light
    mean = float(light.mean())
    kinds = np.stack([np.ones_like(light), light - mean])
    (constant,), plain = _scatter_of(kinds[:1], np.array([start]), *rays)
    spread = float(np.ptp(light))
    if spread >= _LEAST_SPREAD:
        (level, of_light), varied = _scatter_of(kinds, np.array([constant, 0.0]), *rays)
        corner = _corner(plain)
        left = [float((np.minimum(deviation, corner) ** 2).sum()) for deviation in (plain, varied)]
        if left[1] < (1 - _BETTER) * left[0] and abs(of_light) * spread < LARGEST_SCATTER:
            return Scatter(level - of_light * mean, of_light)
    return Scatter(min(max(constant, 0.0), LARGEST_SCATTER))


def misfit_left(
    sample: FittedRays, spectrum: Spectrum | None, materials: Materials | None, was: Scatter, now: Scatter
) -> float:
    """How much of the rays' misfit is left under other scatter, each with the best factor of every curve's amount.

    The misfit is Huber's, and where it has its corner changes hardly anything.

    Parameters
    ----------
    sample : FittedRays
        Of a fit that assumed the scatter ``was``.
    spectrum, materials : Spectrum, Materials, or None
        See `estimate_scatter`.
    was, now : Scatter
    """
    from scipy.special import huber

    rays, light = _rays(sample, spectrum, materials), torch.as_tensor(sample.light)
    before, after = (_deviation(scatter.at(light).numpy(), *rays) for scatter in (was, now))
    corner = _corner(before)
    sums = [float(huber(corner, deviation).sum()) for deviation in (before, after)]
    return sums[1] / sums[0] if sums[0] else 1.0


def _rays(
    sample: FittedRays, spectrum: Spectrum | None, materials: Materials | None
) -> tuple[np.ndarray, ...]:
    """What passes of rays, its slopes by a factor of each curve's amount, what was measured, and its weight."""
    if spectrum is None or materials is None:
        return np.exp(-sample.areal[0]), sample.areal[:1], sample.measured, sample.weight
    lit = spectrum.weights > 0
    curves = materials.mass_attenuation(spectrum.energies[lit])[: len(sample.areal)]
    value, share = shares(sample.areal, np.log(spectrum.weights[lit]), curves)
    slopes = np.einsum("kn,nr->kr", curves, share) * sample.areal
    return np.exp(-value), slopes, sample.measured, sample.weight


def _deviation(
    scatter: np.ndarray, primary: np.ndarray, slopes: np.ndarray, measured: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    """What rays lack under some scatter, with the amounts of the curves that are best under it."""
    columns, target = _linearised(np.empty((0, len(scatter))), scatter, primary, slopes, measured, weight)
    deviation = np.abs(target)
    for _ in range(_GAUSS_NEWTON_STEPS):
        robust = _robust(deviation)
        step = np.linalg.lstsq((columns * robust).T, target * robust, rcond=None)[0]
        deviation = np.abs(target - step @ columns)
    return deviation


def _scatter_of(
    kinds: np.ndarray,
    amounts: np.ndarray,
    primary: np.ndarray,
    slopes: np.ndarray,
    measured: np.ndarray,
    weight: np.ndarray,
) -> tuple[list[float], np.ndarray]:
    """Amounts of some kinds of scatter, from the first ones on, that explain rays best, and what these then lack."""
    robust = np.ones_like(measured)
    for _ in range(_GAUSS_NEWTON_STEPS):
        columns, target = _linearised(kinds, amounts @ kinds, primary, slopes, measured, weight)
        step = np.linalg.lstsq((columns * robust).T, target * robust, rcond=None)[0]
        amounts = amounts + step[: len(kinds)]
        # The mean scatter; what it differs by is bounded ray by ray.
        amounts[0] = np.clip(amounts[0], 0.0, LARGEST_SCATTER)
        deviation = np.abs(target - step @ columns)
        robust = _robust(deviation)
    columns, target = _linearised(kinds[:0], amounts @ kinds, primary, slopes, measured, weight)
    step = np.linalg.lstsq((columns * robust).T, target * robust, rcond=None)[0]
    return [float(amount) for amount in amounts], np.abs(target - step @ columns)


def _linearised(
    kinds: np.ndarray,
    scatter: np.ndarray,
    primary: np.ndarray,
    slopes: np.ndarray,
    measured: np.ndarray,
    weight: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """What rays under some scatter change by with each kind of it and each curve's amount, and what they lack."""
    within = (scatter >= 0) & (scatter <= LARGEST_SCATTER)
    total = primary + np.clip(scatter, 0.0, LARGEST_SCATTER) + np.finfo(np.float64).tiny
    columns = np.concatenate([-kinds * within / total, slopes * (primary / total)]) * weight
    return columns, (measured + np.log(total)) * weight


def _robust(deviation: np.ndarray) -> np.ndarray:
    """Roots of the weights under which squares count as Huber's function does."""
    corner = _corner(deviation)
    return np.sqrt(corner / np.maximum(deviation, corner))


def _corner(deviation: np.ndarray) -> float:
    return _HUBER_CORNER * _DEVIATION * float(np.median(deviation)) + 1e-12


def matching_factor(
    change: Callable[[Spectrum, float], Spectrum],
    spectrum: Spectrum,
    material: MaterialLike,
    longest: float,
    ratio: float,
    bounds: tuple[float, float],
) -> float:
    """The change of a spectrum under which a material ``ratio`` times as dense gives the same rays.

    Parameters
    ----------
    change : callable
        From a spectrum and a factor to another spectrum.
    spectrum : Spectrum
    material : str or mapping
    longest : float
        Areal density in g/cm2 up to which rays are compared.
    ratio : float
    bounds : (float, float)
        Range of the factor.
    """
    from scipy.optimize import minimize_scalar

    paths = np.linspace(0.0, longest, 41)[1:]

    def rays(under: Spectrum, paths: np.ndarray) -> np.ndarray:
        lit = under.weights > 0
        curve = mass_attenuation(material, under.energies[lit])[None]
        return projection(paths[None], np.log(under.weights[lit]), curve)

    target = rays(spectrum, paths)

    def misfit(factor: float) -> float:
        return float(np.mean((rays(change(spectrum, factor), ratio * paths) - target) ** 2))

    return float(minimize_scalar(misfit, bounds=bounds, method="bounded", options={"xatol": 1e-4}).x)
