"""Material numbers of solids, and what a mixture of the curves is made of."""

import numpy as np
import pytest

from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.materials import density, mass_attenuation
from tomo_polysplat.physics.solids import number_of_solid
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.stand_in import best_stand_in


@pytest.mark.parametrize("kvp, filters", [(60, {"Al": 0.2}), (160, {"Cu": 0.05})])
@pytest.mark.parametrize(
    "material, grams, within",
    [
        ("aluminium", density("aluminium"), 0.05),
        ("SiO2", 2.65, 0.03),
        ("CaCO3", 2.71, 0.1),
        ("titanium", density("titanium"), 0.06),
        ("iron", density("iron"), 0.02),
        ("nickel", density("nickel"), 0.05),
    ],
)
def test_the_attenuation_tells_the_number_of_a_solid(kvp, filters, material, grams, within):
    spectrum = Spectrum.from_tube(kvp, filters=filters)
    energy = spectrum.effective_energy
    level = float(grams * mass_attenuation(material, energy) / mass_attenuation("water", energy))
    expected = min(best_stand_in(material, spectrum).u, 1.0)
    assert number_of_solid(level, energy) == pytest.approx(expected, abs=within)


def test_lighter_than_quartz_and_denser_than_iron_are_their_numbers():
    assert number_of_solid(0.5, 60.0) == number_of_solid(2.0, 60.0) < 0.3
    assert number_of_solid(1e3, 60.0) == 1.0


@pytest.mark.parametrize("u", [0.0, 0.3, 1.0])
def test_a_mixture_of_the_curves_is_a_material(u):
    energies, curves = np.linspace(20, 120, 23), Materials("pmma", "bone", {"Ti": 0.9, "Al": 0.1})
    expected = Materials.mixture(u) @ curves.mass_attenuation(energies)
    assert mass_attenuation(curves.mixed(u), energies) == pytest.approx(expected, rel=1e-12)
