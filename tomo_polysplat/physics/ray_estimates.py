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

__all__ = ["FittedRays", "RaysUnder", "estimate_scatter", "matching_factor", "misfit_left"]

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

    def under(self, spectrum: Spectrum | None, materials: Materials | None) -> RaysUnder:
        """What they are under a spectrum.

        Parameters
        ----------
        spectrum, materials : Spectrum, Materials, or None
            None where the areal densities of the one curve are -log(I / I0) themselves.
        """
        measured = self.measured, self.weight, self.light
        if spectrum is None or materials is None:
            return RaysUnder(np.exp(-self.areal[0]), self.areal[:1], *measured)
        lit = spectrum.weights > 0
        curves = materials.mass_attenuation(spectrum.energies[lit])[: len(self.areal)]
        value, share = shares(self.areal, np.log(spectrum.weights[lit]), curves)
        return RaysUnder(np.exp(-value), np.einsum("kn,nr->kr", curves, share) * self.areal, *measured)


class RaysUnder(NamedTuple):
    """Some rays under a spectrum.

    Attributes
    ----------
    primary : (rays,) array
        What passes of each, as a fraction of the beam.
    slopes : (curves, rays) array
        What ``-log(I / I0)`` changes by with a factor of each curve's amount.
    measured, weight, light : (rays,) arrays
        See `FittedRays`.
    beam_free : bool
        Whether the brightness of the beam is free as well.
    """

    primary: np.ndarray
    slopes: np.ndarray
    measured: np.ndarray
    weight: np.ndarray
    light: np.ndarray
    beam_free: bool = False

    def linearised(self, kinds: np.ndarray, scatter: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What rays under some scatter change by with each kind of it, each curve's amount and the beam's log.

        The second array is what they lack.
        """
        within = (scatter >= 0) & (scatter <= LARGEST_SCATTER)
        total = self.primary + np.clip(scatter, 0.0, LARGEST_SCATTER) + np.finfo(np.float64).tiny
        beam = -np.ones((int(self.beam_free), len(total)))
        columns = np.concatenate([-kinds * within / total, self.slopes * (self.primary / total), beam])
        return columns * self.weight, (self.measured + np.log(total)) * self.weight


def estimate_scatter(
    rays: RaysUnder, start: float = 0.0, *, beam_free: bool = False
) -> tuple[Scatter, float]:
    """Scatter that explains the residuals of rays, at least one, best; it varies where that is needed.

    Gauss-Newton steps with Huber's weights on the scatter together with one factor for the amount of each of
    the curves, so that matter which has taken up some of the scatter gives it back.

    Parameters
    ----------
    rays : RaysUnder
        Of a fit that assumed ``start``.
    start : float
        Constant scatter, as a fraction of the open beam.
    beam_free : bool
        Whether the brightness of the beam is estimated as well. Rays beside the object then do not tell scatter, which
        is constant.

    Returns
    -------
    Scatter
        As a fraction of the beam.
    float
        Brightness of the beam, in those that the rays are relative to; 1 unless it is free.
    """
    rays, light = rays._replace(beam_free=beam_free), rays.light
    mean = float(light.mean())
    kinds = np.stack([np.ones_like(light), light - mean])
    (constant,), beam, plain = _scatter_of(kinds[:1], np.array([start]), rays)
    spread = float(np.ptp(light))
    # A constant under another beam is as free as scatter that varies under the open field.
    if spread >= _LEAST_SPREAD and not beam_free:
        (level, of_light), _, varied = _scatter_of(kinds, np.array([constant, 0.0]), rays)
        corner = _corner(plain)
        left = [float((np.minimum(deviation, corner) ** 2).sum()) for deviation in (plain, varied)]
        if left[1] < (1 - _BETTER) * left[0] and abs(of_light) * spread < LARGEST_SCATTER:
            return Scatter(level - of_light * mean, of_light), beam
    return Scatter(min(max(constant, 0.0), LARGEST_SCATTER)), beam


def misfit_left(rays: RaysUnder, was: Scatter, now: Scatter, *, beam_free: bool = False) -> float:
    """How much of the rays' misfit is left under other scatter, each with the best factor of every curve's amount.

    The misfit is Huber's, and where it has its corner changes hardly anything.

    Parameters
    ----------
    rays : RaysUnder
        Of a fit that assumed the scatter ``was``.
    was, now : Scatter
    beam_free : bool
        Whether the second has the best brightness of the beam as well.
    """
    from scipy.special import huber

    light = torch.as_tensor(rays.light)
    before = _deviation(was.at(light).numpy(), rays)
    after = _deviation(now.at(light).numpy(), rays._replace(beam_free=beam_free))
    corner = _corner(before)
    sums = [float(huber(corner, deviation).sum()) for deviation in (before, after)]
    return sums[1] / sums[0] if sums[0] else 1.0


def _deviation(scatter: np.ndarray, rays: RaysUnder) -> np.ndarray:
    """What rays lack under some scatter, with the amounts of the curves that are best under it."""
    columns, target = rays.linearised(np.empty((0, len(scatter))), scatter)
    deviation = np.abs(target)
    for _ in range(_GAUSS_NEWTON_STEPS):
        robust = _robust(deviation)
        step = np.linalg.lstsq((columns * robust).T, target * robust, rcond=None)[0]
        deviation = np.abs(target - step @ columns)
    return deviation


def _scatter_of(
    kinds: np.ndarray, amounts: np.ndarray, rays: RaysUnder
) -> tuple[list[float], float, np.ndarray]:
    """Amounts of some kinds of scatter, from the first ones on, and the beam, that explain rays best; what is left."""
    robust = np.ones_like(rays.measured)
    for _ in range(_GAUSS_NEWTON_STEPS):
        columns, target = rays.linearised(kinds, amounts @ kinds)
        step = np.linalg.lstsq((columns * robust).T, target * robust, rcond=None)[0]
        amounts = amounts + step[: len(kinds)]
        # The mean scatter; what it differs by is bounded ray by ray.
        amounts[0] = np.clip(amounts[0], 0.0, LARGEST_SCATTER)
        deviation = np.abs(target - step @ columns)
        robust = _robust(deviation)
    columns, target = rays.linearised(kinds[:0], amounts @ kinds)
    step = np.linalg.lstsq((columns * robust).T, target * robust, rcond=None)[0]
    beam = float(np.exp(step[-1])) if rays.beam_free else 1.0
    return [float(amount) for amount in amounts], beam, np.abs(target - step @ columns)


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
