"""What a detector makes of the photons that reach it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail, require_number
from tomo_polysplat.physics.detector_text import detector_parts
from tomo_polysplat.physics.materials import composition, density, mass_attenuation, require_energies

__all__ = ["Detector"]


@dataclass(frozen=True)
class Detector:
    """Relative signal per photon as a function of its energy.

    Made by ``Detector.named``, ``Detector.photon_counting`` or ``Detector.energy_integrating``. A photon
    that interacts in the sensor, with probability ``1 - exp(-mu t)``, gives one count, or a signal
    proportional to its whole energy: escape of fluorescence and light yield that is not proportional are not
    modelled. Give
    ``Spectrum(energies, weights)`` with a measured response where they matter.

    Attributes
    ----------
    integrating : bool
        Whether the signal is proportional to the photon's energy.
    sensor : str or None
        Material that absorbs the photons; None for an ideal one that absorbs all.
    thickness_cm : float
        Its thickness in cm.
    threshold_kev : float
        Photons of less energy are not counted.
    """

    integrating: bool = False
    sensor: str | None = None
    thickness_cm: float = 0.0
    threshold_kev: float = 0.0

    def __post_init__(self) -> None:
        require_number("thickness_cm", self.thickness_cm, at_least=0.0)
        require_number("threshold_kev", self.threshold_kev, at_least=0.0)
        if self.sensor is not None:
            if not isinstance(self.sensor, str):
                raise fail("sensor", "the name of a material", repr(self.sensor), error=TypeError)
            composition(self.sensor)
            require_number(
                "thickness_cm", self.thickness_cm, above=0.0, remedy="or leave the sensor out: all absorbed"
            )
        elif self.thickness_cm > 0:
            raise fail("sensor", "a material with a thickness", "None", 'such as sensor="CdTe"')

    @classmethod
    def named(cls, text: str, argument: str = "detector") -> Detector:
        """A detector by its usual name, such as ``"csi:0.6mm"``, ``"gos:0.2mm"``, ``"cdte:1mm:20kev"``, ``"counting"``.

        Parameters
        ----------
        text : str
            The name, the thickness of what absorbs the photons, and the threshold where it counts them, with colons
            between: csi, gos, luag, yag and cdwo4 integrate the energy; silicon, cdte and gaas count. Any material
            comes after ``counting:`` or ``integrating:``; these alone absorb all. A powder has less matter than its
            thickness tells: give what its mass per area makes, about half.
        argument : str
            For errors.

        Raises
        ------
        ValueError
            For an unknown name or material, or what is no thickness.
        """
        try:
            return cls(**detector_parts(argument, text))
        except ValueError as error:
            if str(error).startswith(f"{argument}:"):
                raise
            raise fail(argument, "a known material of some thickness", f"{text!r} ({error})") from None

    @classmethod
    def photon_counting(
        cls, sensor: str | None = None, thickness_cm: float = 0.0, threshold_kev: float = 0.0
    ) -> Detector:
        """One count for every photon absorbed above a threshold.

        Parameters
        ----------
        sensor : str, optional
            Material that absorbs the photons, such as ``"CdTe"``; None absorbs all.
        thickness_cm : float
            Its thickness in cm.
        threshold_kev : float
            Photons of less energy are not counted.

        Raises
        ------
        ValueError
            For an unknown material, one without a thickness, a thickness without one, or negative numbers.
        """
        return cls(False, sensor, thickness_cm, threshold_kev)

    @classmethod
    def energy_integrating(cls, scintillator: str | None = "CsI", thickness_cm: float = 0.06) -> Detector:
        """Signal proportional to the absorbed energy, such as a flat panel's.

        Parameters
        ----------
        scintillator : str, optional
            Material that absorbs the photons; None absorbs all.
        thickness_cm : float
            Its thickness in cm; not read without a scintillator.

        Raises
        ------
        ValueError
            For an unknown material or a thickness that is not above 0.
        """
        return cls(True, scintillator, thickness_cm if scintillator is not None else 0.0)

    def response(self, energies_kev: Any) -> np.ndarray:
        """Relative signal per photon, ``(n,)`` float64: a probability, or keV if integrating.

        Parameters
        ----------
        energies_kev : (n,) array_like
            Energies in keV.

        Raises
        ------
        ValueError
            For energies outside the tables, 0.1-800 keV.
        """
        energies = require_energies("energies_kev", energies_kev)
        signal = energies.copy() if self.integrating else np.ones_like(energies)
        if self.sensor is not None:
            path = density(self.sensor) * self.thickness_cm
            signal *= -np.expm1(-path * mass_attenuation(self.sensor, energies))
        return np.where(energies >= self.threshold_kev, signal, 0.0)

    def describe(self) -> str:
        """One phrase, such as ``"energy integrating, 0.06 cm CsI"``."""
        parts = ["energy integrating" if self.integrating else "photon counting"]
        if self.sensor is not None:
            parts.append(f"{self.thickness_cm:g} cm {self.sensor}")
        if self.threshold_kev > 0:
            parts.append(f"above {self.threshold_kev:g} keV")
        return ", ".join(parts)
