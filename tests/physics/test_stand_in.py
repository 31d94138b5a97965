"""Which mixture of three curves stands in for a material."""

import pytest

from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.stand_in import best_stand_in

SPECTRUM = Spectrum.from_tube(90, filters={"Al": 0.1})


@pytest.mark.parametrize("material, u", [("water", 0.0), ("iron", 1.0)])
def test_a_base_material_stands_for_itself(material, u):
    found = best_stand_in(material, SPECTRUM)
    assert found.u == pytest.approx(u, abs=1e-4)
    assert found.density == pytest.approx(1.0, abs=1e-4)
    assert abs(found.attenuation_error) < 1e-4 and found.projection_error < 1e-5


def test_a_free_number_is_never_worse_than_a_held_one():
    for material in ("pmma", "titanium", "I"):
        free = best_stand_in(material, SPECTRUM)
        held = best_stand_in(material, SPECTRUM, bounds=(0.0, 0.0))
        assert held.u == 0.0 and free.projection_error <= held.projection_error


def test_naming_a_material_with_an_edge_mends_it():
    default = best_stand_in("I", SPECTRUM)
    named = best_stand_in("I", SPECTRUM, Materials("water", "aluminium", "I"))
    assert abs(default.attenuation_error) > 0.1 > 1e-3 > abs(named.attenuation_error)
