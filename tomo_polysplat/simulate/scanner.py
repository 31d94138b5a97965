"""From material along the rays to what a detector reads: spectrum, scatter, counting noise, logarithm."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tomo_polysplat.checks import require_number
from tomo_polysplat.compiled import njit

__all__ = ["Scanner", "transmission"]


def transmission(areal: np.ndarray, attenuation: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Fraction of the detected signal that passes, by Beer-Lambert at every energy of the spectrum.

    .. math:: T = \\sum_E \\eta(E) \\exp(-\\sum_m a_m \\mu_m(E))

    Parameters
    ----------
    areal : (..., materials)
        Areal densities a in g/cm2.
    attenuation : (materials, energies)
        Mass attenuation in cm2/g.
    weights : (energies,)
        Spectrum seen by the detector without an object, of sum 1.

    Returns
    -------
    (...) float64
    """
    passed = np.empty(areal.shape[:-1])
    # A spectrum's weights are read-only, which `_transmit` would be compiled for once more.
    _transmit(areal.reshape(-1, areal.shape[-1]), attenuation, np.array(weights), passed.reshape(-1))
    return passed


# Compiled rather than a matrix product: views share the CPU already, and BLAS threads would fight over it.
@njit(nogil=True, cache=True)
def _transmit(areal, attenuation, weights, out):
    air = weights.sum()
    for ray in range(len(areal)):
        if not areal[ray].any():
            out[ray] = air
            continue
        total = 0.0
        for energy in range(len(weights)):
            exponent = 0.0
            for material in range(len(attenuation)):
                exponent += areal[ray, material] * attenuation[material, energy]
            total += weights[energy] * math.exp(-exponent)
        out[ray] = total


@dataclass(frozen=True)
class Scanner:
    """A detector and its exposure.

    The counts of a pixel are Poisson with mean ``photons (T + scatter)``, T being its transmission, plus
    Gaussian read-out noise; the flat field is noise-free and without scatter. An energy-integrating detector
    is treated as one that counts as many quanta, each of them drawn from its response-weighted spectrum.

    Attributes
    ----------
    photons : float
        Mean counts of a pixel without an object.
    electronic_noise : float
        Standard deviation of the read-out noise, in counts.
    scatter : float
        Constant scattered signal, as a fraction of ``photons``, at most 1.
    noise : bool
        False for the exact mean signal.
    seed : int
    """

    photons: float = 1e5
    electronic_noise: float = 3.0
    scatter: float = 0.0
    noise: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        # NumPy draws Poisson numbers as 64-bit integers.
        require_number("photons", self.photons, above=0.0, at_most=1e18)
        require_number("electronic_noise", self.electronic_noise, at_least=0.0)
        remedy = "a share of the open beam: 0.05 for 5 %"
        require_number("scatter", self.scatter, at_least=0.0, at_most=1.0, remedy=remedy)
        require_number("seed", self.seed, at_least=0)

    def counts(self, passed: np.ndarray, view: int) -> np.ndarray:
        """Counts of one view, of the shape of ``passed``; the noise depends on seed and view only."""
        mean = self.photons * (passed + self.scatter)
        if not self.noise:
            return mean
        generator = np.random.default_rng((int(self.seed), view))
        return generator.poisson(mean) + self.electronic_noise * generator.standard_normal(mean.shape)

    def projection(self, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``-log(counts / photons)`` and where it is a measurement.

        A noisy pixel that read less than one count saw no light: it is given the value of one count and
        marked as invalid. Nothing else is clipped; in air the noise makes some values negative.
        """
        lowest = 1.0 if self.noise else np.finfo(float).tiny
        valid = counts >= lowest
        return -np.log(np.maximum(counts, lowest) / self.photons), valid
