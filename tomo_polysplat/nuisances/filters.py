"""The tube's filters as a nuisance: a factor of the thickness that the spectrum was told for."""

from __future__ import annotations

from tomo_polysplat.nuisances.nuisance import Parameter
from tomo_polysplat.nuisances.spectral_factor import SpectralFactor
from tomo_polysplat.physics.spectral_change import with_filtration
from tomo_polysplat.physics.spectrum import Spectrum

__all__ = ["Filters"]


class Filters(SpectralFactor):
    """The thickness of the tube's filters, as aluminium, in times the one that was told."""

    name = "filter"
    words = "filters"
    parameters = {"filter": Parameter("of the told thickness", 1.0, 0.4, 2.5)}

    @classmethod
    def change(cls, spectrum: Spectrum, factor: float) -> Spectrum:
        """See `physics.spectral_change.with_filtration`."""
        return with_filtration(spectrum, factor)
