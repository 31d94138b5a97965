"""A tube's spectrum at another voltage or behind another filter, against the tube that has them."""

import numpy as np
import pytest

from tomo_polysplat.physics.detector import Detector
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.physics.spectral_change import (
    aluminium_equivalent,
    tube_voltage,
    with_filtration,
    with_voltage,
)
from tomo_polysplat.physics.spectrum import Spectrum

AL = {"Al": 0.1}


def through(spectrum, material):
    paths = np.array([0.5, 2.0, 10.0])
    exponents = -np.outer(paths, mass_attenuation(material, spectrum.energies))
    return -np.log(np.exp(exponents) @ spectrum.weights)


@pytest.mark.parametrize("detector", [None, Detector.energy_integrating()])
@pytest.mark.parametrize(
    "kvp, other", [(81, 90), (99, 90), (90.5, 81.3), (90.02, 99), (90.9, 85), (120, 132)]
)
def test_another_voltage_is_that_of_the_tube(kvp, other, detector):
    spectrum, wanted = (Spectrum.from_tube(v, filters=AL, detector=detector) for v in (kvp, other))
    assert tube_voltage(spectrum) == pytest.approx(kvp, abs=1e-6)
    changed = with_voltage(spectrum, other / tube_voltage(spectrum))
    for material in ("water", "iron"):
        gap = np.abs(through(spectrum, material) - through(wanted, material)).max()
        assert np.abs(through(changed, material) - through(wanted, material)).max() < 0.05 * gap
    assert changed.effective_energy == pytest.approx(wanted.effective_energy, abs=0.1)


def test_the_same_voltage_changes_nothing():
    spectrum = Spectrum.from_tube(100, filters=AL)
    same = with_voltage(spectrum, 1.0)
    # Energies with next to no weight may be left out.
    kept = np.interp(spectrum.energies, same.energies, same.weights)
    np.testing.assert_allclose(kept, spectrum.weights, atol=1e-9)


def test_filtration_is_a_thickness_of_aluminium():
    spectrum = Spectrum.from_tube(90, filters=AL)
    assert aluminium_equivalent(spectrum) == pytest.approx(0.1, rel=1e-6)
    thicker = Spectrum.from_tube(90, filters={"Al": 0.12})
    np.testing.assert_allclose(with_filtration(spectrum, 1.2).weights, thicker.weights, atol=1e-9)


@pytest.mark.parametrize(
    "spectrum", [Spectrum.monochromatic(60), Spectrum(np.linspace(8, 18, 40), np.ones(40), "synchrotron")]
)
def test_what_no_tube_made_is_refused(spectrum):
    with pytest.raises(ValueError, match="spectrum: expected the spectrum of an x-ray tube"):
        tube_voltage(spectrum)


def test_a_voltage_outside_the_tables_is_refused():
    with pytest.raises(ValueError, match="tube voltage"):
        with_voltage(Spectrum.from_tube(400, filters=AL), 1.2)
