"""What a change of the tube's voltage and one of its filters have in common: a known density tells either.

Neither shows in the rays: a voltage changed by 10 % scales the object and leaves the rest of a fitted volume within
half a per cent (``docs/spectrum.md``).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

from tomo_polysplat.nuisances.nuisance import Found, Nuisance, Place, Verdict
from tomo_polysplat.physics.materials import MaterialLike
from tomo_polysplat.physics.ray_estimates import matching_factor
from tomo_polysplat.physics.spectrum import Spectrum

__all__ = ["SpectralFactor"]

# Densities closer than this are left as they are.
_LEAST_CHANGE = 0.02
# A known density is taken at its word unless the rays contradict it by as much.
_CONTRADICTION = 0.1


class SpectralFactor(Nuisance):
    """A factor of the assumed spectrum.

    Attributes
    ----------
    words : str
        What is changed, for a report.
    """

    words: ClassVar[str]
    place = Place.SPECTRUM
    found_by = Found.DENSITY
    gauge = "the object's density: the caller knows that of its main matter"
    cost = "two or three short fits, twice as long as others"

    @classmethod
    @abstractmethod
    def change(cls, spectrum: Spectrum, factor: float) -> Spectrum:
        """The spectrum under a factor."""

    @classmethod
    def bounds(cls, spectrum: Spectrum) -> tuple[float, float]:
        """Range of the factor for an assumed spectrum."""
        of = cls.parameters[cls.name]
        return of.least, of.most

    @classmethod
    def gate(cls, evidence: Mapping[str, float]) -> Verdict:
        """Whether a ``factor`` lies between ``least`` and ``most``, and the held-out rays do not contradict it."""
        factor, change = evidence["factor"], f"{evidence['factor']:.4g}"
        if not 1.001 * evidence["least"] < factor < 0.999 * evidence["most"]:
            return Verdict(
                False, f"times {change} is as far as is looked, and the density asks for more: not accepted"
            )
        before, after = evidence["held_out_before"], evidence["held_out_after"]
        kept = after < (1 + _CONTRADICTION) * before
        errors = f"held-out error {before:.3e} before, {after:.3e} after"
        return Verdict(
            kept, f"times {change} by the known density, {'accepted' if kept else 'not accepted'}: {errors}"
        )

    @classmethod
    def told(cls, values: Mapping[str, Any]) -> str:
        """The factor."""
        factor = float(values.get(cls.name, 1.0))
        return "" if factor == 1.0 else f"{cls.words} {factor:.4g} times as told"

    @classmethod
    def moved(
        cls,
        was: float,
        ratio: float,
        longest: float,
        spectrum: Spectrum,
        material: MaterialLike,
        told: Spectrum,
    ) -> dict[str, float]:
        """The factor under which the main matter is ``ratio`` times as dense; nothing where that is where it was.

        Parameters
        ----------
        was : float
            The factor that was assumed.
        ratio : float
        longest : float
            Areal density in g/cm2 up to which rays are compared.
        spectrum, told : Spectrum
            Under the factor that was assumed, and under none.
        material : str or mapping
            The main matter.
        """
        if abs(ratio - 1.0) < _LEAST_CHANGE:
            return {}
        low, high = cls.bounds(told)
        value = was * matching_factor(cls.change, spectrum, material, longest, ratio, (low / was, high / was))
        return {} if value == was else {cls.name: value}
