"""What rays of known areal densities tell about scatter and spectrum."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.beer_lambert import projection, shares
from tomo_polysplat.physics.materials import MaterialLike, mass_attenuation
from tomo_polysplat.physics.spectrum import Spectrum

__all__ = ["estimate_scatter", "matching_factor"]

_LARGEST_SCATTER = 0.2
_GAUSS_NEWTON_STEPS = 8
# Residuals count absolutely beyond this many deviations (Huber 1964, doi:10.1214/aoms/1177703732).
_HUBER_CORNER = 1.345
_DEVIATION = 1.4826  # standard deviation of a normal distribution over its median absolute deviation


def estimate_scatter(
    areal: np.ndarray,
    measured: np.ndarray,
    weight: np.ndarray,
    spectrum: Spectrum,
    materials: Materials,
    start: float = 0.0,
) -> float:
    """Constant scatter that explains the residuals of rays best.

    Gauss-Newton steps with Huber's weights on the scatter together with one factor for the amount of each of
    the three curves, so that matter which has taken up some of the scatter gives it back.

    Parameters
    ----------
    areal : (3, rays) array
        Areal densities in g/cm2 of a fit that assumed ``start``.
    measured, weight : (rays,) arrays
        ``-log(I / I0)``, and what residuals are multiplied with.
    spectrum : Spectrum
    materials : Materials
    start : float
        Fraction of the open beam.

    Returns
    -------
    float
        Fraction of the open beam, 0 to 0.2.
    """
    lit = spectrum.weights > 0
    curves = materials.mass_attenuation(spectrum.energies[lit])
    value, share = shares(areal, np.log(spectrum.weights[lit]), curves)
    primary, slopes = np.exp(-value), (curves @ share) * areal
    scatter, robust = start, np.ones_like(value)
    for _ in range(_GAUSS_NEWTON_STEPS):
        total = np.maximum(primary + scatter, np.finfo(np.float64).tiny)
        columns = np.concatenate([(-1.0 / total)[None], slopes * (primary / total)]) * weight
        target = (measured + np.log(total)) * weight
        step = np.linalg.lstsq((columns * robust).T, target * robust, rcond=None)[0]
        scatter = float(np.clip(scatter + step[0], 0.0, _LARGEST_SCATTER))
        deviation = np.abs(target - step @ columns)
        corner = _HUBER_CORNER * _DEVIATION * np.median(deviation) + 1e-12
        robust = np.sqrt(corner / np.maximum(deviation, corner))
    return scatter


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
