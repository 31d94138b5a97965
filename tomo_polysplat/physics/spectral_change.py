"""The same tube at another voltage or behind another thickness of filter, when only its spectrum is known."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.checks import fail, require_number
from tomo_polysplat.physics.materials import density, mass_attenuation
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.tube_tables import tube_counts, voltage_range

__all__ = ["aluminium_equivalent", "tube_voltage", "with_filtration", "with_voltage"]

# Where a tube emits less than this share of its peak, what is left of it says little about filters.
_FLOOR = 1e-4
# As few energies are no tube's.
_FEWEST = 10
# keV below the end point over which filters and detector are continued beyond it by a straight line.
_END_RANGE = 12.0


def tube_voltage(spectrum: Spectrum) -> float:
    """Tube voltage in kV: where the spectrum ends.

    Raises
    ------
    ValueError
        If a tungsten tube cannot have made the spectrum.
    """
    energies = spectrum.energies
    lowest, highest = voltage_range("W")
    # The last bin is cut at the voltage, and narrower than those before it.
    end = 2 * energies[-1] - (1.5 * energies[-2] - 0.5 * energies[-3]) if len(energies) >= _FEWEST else 0.0
    if not lowest <= end <= highest:
        expected = f"the spectrum of an x-ray tube of {lowest:g} to {highest:g} kV"
        remedy = "leave its voltage and filters as they are"
        raise fail("spectrum", expected, spectrum.describe(), remedy)
    return float(end)


def with_voltage(spectrum: Spectrum, factor: float) -> Spectrum:
    """The spectrum with the tube voltage times a factor, filters and detector unchanged.

    What filters and detector do to each energy is the spectrum over that of a bare tungsten tube
    (:mod:`tomo_polysplat.physics.tube_tables`), continued beyond the end point by a straight line of its
    logarithm. For a spectrum of ``Spectrum.from_tube`` with a tungsten anode the result is what it gives at
    the other voltage.
    """
    kvp = tube_voltage(spectrum)
    changed = kvp * require_number("factor", factor, above=0.0)
    lowest, highest = voltage_range("W")
    require_number("tube voltage", changed, at_least=lowest, at_most=highest)
    energies, log_passed = _passed(spectrum, kvp)
    near = energies > energies[-1] - _END_RANGE
    slope, offset = np.polyfit(energies[near], log_passed[near], 1)
    wanted, counts = tube_counts(changed)
    log_share = np.interp(wanted, energies, log_passed)
    log_share = np.where(wanted > energies[-1], offset + slope * wanted, log_share)
    weights = np.where(wanted < energies[0], 0.0, counts * np.exp(log_share - log_share.max()))
    return Spectrum(wanted, weights, f"{spectrum.label}, at {changed:.4g} kV")


def aluminium_equivalent(spectrum: Spectrum) -> float:
    """Thickness of aluminium in cm that a tube's filters are worth; 0.01 at least."""
    energies, log_passed = _passed(spectrum, tube_voltage(spectrum))
    weights = np.sqrt(np.interp(energies, spectrum.energies, spectrum.weights))
    curve = density("aluminium") * mass_attenuation("aluminium", energies)
    slope = np.polyfit(curve, log_passed, 1, w=weights)[0]
    return max(0.01, -float(slope))


def with_filtration(spectrum: Spectrum, factor: float) -> Spectrum:
    """The spectrum with the filters' thickness, as aluminium, times a factor."""
    extra = (require_number("factor", factor, at_least=0.0) - 1.0) * aluminium_equivalent(spectrum)
    exponent = -extra * density("aluminium") * mass_attenuation("aluminium", spectrum.energies)
    lit = spectrum.weights > 0
    weights = np.where(lit, spectrum.weights * np.exp(exponent - exponent[lit].max()), 0.0)
    return Spectrum(spectrum.energies, weights, f"{spectrum.label}, filters times {factor:.4g}")


def _passed(spectrum: Spectrum, kvp: float) -> tuple[np.ndarray, np.ndarray]:
    """Energies, and the logarithm of the share that filters and detector leave of a bare tube, but for a factor."""
    energies, counts = tube_counts(kvp)
    per_kev = spectrum.weights / np.gradient(spectrum.energies)
    ratio = np.interp(energies, spectrum.energies, per_kev, left=0.0)
    bare = counts / np.gradient(energies)
    used = (ratio > _FLOOR * 1e-8 * ratio.max()) & (bare > _FLOOR * bare.max())
    return energies[used], np.log(ratio[used] / bare[used])
