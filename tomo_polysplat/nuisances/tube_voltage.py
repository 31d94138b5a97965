"""The tube's voltage as a nuisance: a factor of the one that the spectrum was told for."""

from __future__ import annotations

from tomo_polysplat.nuisances.nuisance import Parameter
from tomo_polysplat.nuisances.spectral_factor import SpectralFactor
from tomo_polysplat.physics.spectral_change import tube_voltage, with_voltage
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.tube_tables import voltage_range

__all__ = ["TubeVoltage"]


class TubeVoltage(SpectralFactor):
    """The tube's voltage, in times the one that was told."""

    name = "kvp"
    words = "a tube voltage"
    parameters = {"kvp": Parameter("of the told voltage", 1.0, 0.8, 1.25)}

    @classmethod
    def change(cls, spectrum: Spectrum, factor: float) -> Spectrum:
        """See `physics.spectral_change.with_voltage`."""
        return with_voltage(spectrum, factor)

    @classmethod
    def bounds(cls, spectrum: Spectrum) -> tuple[float, float]:
        """They end where the tables of tubes do."""
        low, high = super().bounds(spectrum)
        # A hair inside: dividing and multiplying by a factor rounds.
        first, last = (end / tube_voltage(spectrum) for end in voltage_range("W"))
        return max(low, first * (1 + 1e-9)), min(high, last * (1 - 1e-9))
