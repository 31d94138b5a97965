"""How well the mixture of three curves stands in for a material that is none of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.beer_lambert import projection, shares
from tomo_polysplat.physics.material_range import LEAST_U
from tomo_polysplat.physics.materials import MaterialLike, mass_attenuation
from tomo_polysplat.physics.spectrum import Spectrum

__all__ = ["StandIn", "best_stand_in"]

_LEVELS = 60
_GRID = 45
# Of the logarithm of a density: steps at most, and one so small that it is the last.
_MOST_STEPS, _SMALLEST_STEP = 50, 1e-10


@dataclass(frozen=True)
class StandIn:
    """The density and the material number whose rays look most like those of a material.

    Attributes
    ----------
    u : float
        Material number.
    density : float
        Over the true density.
    attenuation_error : float
        Relative error of the attenuation at the spectrum's effective energy.
    projection_error : float
        Root mean square error of P over the rays.
    """

    u: float
    density: float
    attenuation_error: float
    projection_error: float


def best_stand_in(
    material: MaterialLike,
    spectrum: Spectrum,
    materials: Materials | None = None,
    *,
    largest: float = 5.0,
    bounds: tuple[float, float] = (LEAST_U, 1.0),
) -> StandIn:
    """The mixture that a fit would put in the place of a material.

    Rays of the pure material, at equal steps of P up to a largest value, are fitted with a density and a
    material number by least squares of P.

    Parameters
    ----------
    material : str or mapping
        Anything ``mass_attenuation`` accepts.
    spectrum : Spectrum
    materials : Materials, optional
        The three curves; water, aluminium and iron by default.
    largest : float
        Largest P of the rays.
    bounds : (float, float)
        Range of the material number; two equal values hold it.
    """
    curves = materials or Materials()
    lit = spectrum.weights > 0
    log_weights, energies = np.log(spectrum.weights[lit]), spectrum.energies[lit]
    own, base = mass_attenuation(material, energies), curves.mass_attenuation(energies)
    # Any path that is long enough; P is then cut at the largest value.
    long = np.geomspace(1e-6, 50.0 * largest / own.min(), 4000)
    levels = np.linspace(0.0, largest, _LEVELS + 1)[1:]
    paths = np.interp(levels, projection(long[None], log_weights, own[None]), long)
    target = projection(paths[None], log_weights, own[None])

    def fitted(u: float) -> tuple[float, float]:
        """Density and mean squared error of P of a material number."""
        curve = (Materials.mixture(u) @ base)[None]
        if curve.min() <= 0:  # below 0 the mixture takes the middle curve away, which may be too much
            return np.nan, np.inf
        return _density(paths, target, log_weights, curve, float((own / curve[0]).mean()))

    u = bounds[0] if bounds[0] == bounds[1] else _least(lambda u: fitted(u)[1], bounds)
    density, squared = fitted(u)
    energy = [spectrum.effective_energy]
    shown = density * float(Materials.mixture(u) @ curves.mass_attenuation(energy)[:, 0])
    return StandIn(
        u, density, shown / float(mass_attenuation(material, energy)[0]) - 1.0, float(np.sqrt(squared))
    )


def _density(
    paths: np.ndarray, target: np.ndarray, log_weights: np.ndarray, curve: np.ndarray, first: float
) -> tuple[float, float]:
    """Density of least squares of P, from a first one on, and its mean squared error.

    Steps of Gauss and Newton in its logarithm: P is nearly a line of it, so that a few are enough.
    """
    density = first
    for _ in range(_MOST_STEPS):
        value, share = shares(density * paths[None], log_weights, curve)
        left, rise = target - value, density * paths * (curve[0] @ share)
        step = float(rise @ left / (rise @ rise))
        density *= math.exp(min(max(step, -1.0), 1.0))
        if abs(step) < _SMALLEST_STEP:
            break
    value = projection(density * paths[None], log_weights, curve)
    return density, float(np.mean((value - target) ** 2))


def _least(function: Callable[[float], float], bounds: tuple[float, float]) -> float:
    """Where a function of one number is least: the best of a grid, refined between its neighbours."""
    from scipy.optimize import minimize_scalar

    grid = np.linspace(*bounds, _GRID)
    values = [function(u) for u in grid]
    best = int(np.argmin(values))
    around = (grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)])
    found = minimize_scalar(function, bounds=around, method="bounded", options={"xatol": 1e-6})
    # The refinement never reaches the ends themselves.
    return float(found.x) if found.fun < values[best] else float(grid[best])
