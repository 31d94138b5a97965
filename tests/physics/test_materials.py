"""Attenuation against NIST's tables, names, mixtures, and errors that help."""

import numpy as np
import pytest

from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.detector import Detector
from tomo_polysplat.physics.materials import composition, density, mass_attenuation

# Total mass attenuation with coherent scattering, cm2/g, at 20, 60 and 100 keV: NIST XAAMDI (NISTIR 5632).
NIST = {
    "water": (0.8096, 0.2059, 0.1707),
    "aluminium": (3.441, 0.2778, 0.1704),
    "iron": (25.68, 1.205, 0.3717),
    "bone": (4.001, 0.3148, 0.1855),
    "Pb": (86.36, 5.021, 5.549),
    "I": (25.43, 7.579, 1.942),
}


@pytest.mark.parametrize("material", NIST)
def test_agrees_with_nist(material):
    np.testing.assert_allclose(mass_attenuation(material, [20.0, 60.0, 100.0]), NIST[material], rtol=0.02)


def test_absorption_edge_is_sharp():
    below, above = mass_attenuation("iodine", [33.1, 33.25])  # K edge at 33.17 keV
    assert above / below == pytest.approx(5.4, rel=0.03)


def test_compound_adds_by_mass():
    energies = np.linspace(15.0, 150.0, 7)
    oxygen, zirconium = 2 * 15.999, 91.224
    expected = oxygen * mass_attenuation("O", energies) + zirconium * mass_attenuation("Zr", energies)
    np.testing.assert_allclose(mass_attenuation("ZrO2", energies), expected / (oxygen + zirconium), rtol=1e-3)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("Fe", "iron"),
        ("aluminum", "Aluminium"),
        ("H2O", "water"),
        ("stainless-steel", "Stainless Steel"),
        ("cortical bone", "bone"),
        ("Ti6Al4V", {"Ti": 0.9, "Al": 0.06, "V": 0.04}),
        ("pmma", "C5H8O2"),
        ({"water": 0.5, "Fe": 0.5}, {"Fe": 0.5, "H2O": 0.5}),
    ],
)
def test_names_of_the_same_material(one, other):
    assert dict(composition(one)) == pytest.approx(dict(composition(other)), rel=1e-6)


def test_symbols_are_case_sensitive():
    assert dict(composition("Co")) == {"Co": 1.0}
    assert set(dict(composition("CO"))) == {"C", "O"}


def test_densities():
    assert density("water") == 1.0
    assert density("Al") == pytest.approx(2.70, rel=0.01)
    assert density("CsI") == pytest.approx(4.51)
    assert density("Ti6Al4V") == pytest.approx(4.43)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: mass_attenuation("iorn", [60.0]), "did you mean iron"),
        (lambda: mass_attenuation("fe", [60.0]), "did you mean Fe"),
        (lambda: mass_attenuation("Xx2", [60.0]), "case-sensitive"),
        (lambda: mass_attenuation({"Ti": 0.9}, [60.0]), "add up to 1"),
        (lambda: mass_attenuation("Fe", [60e3]), "divide by 1000"),
        (lambda: mass_attenuation("Fe", [np.nan]), "energies_kev"),
        (lambda: density("C3H8"), "known density"),
        (lambda: density("unobtainium"), "known mixture"),
        (lambda: Materials("water", "alumnium", "iron"), "alumin"),
        (lambda: Materials.of(("water", "iron")), "three materials"),
    ],
)
def test_clear_errors(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_cache_cannot_be_spoiled():
    first = mass_attenuation("water", [60.0])
    first[:] = -1.0
    assert mass_attenuation("water", [60.0])[0] > 0


def test_base_materials_and_their_mixture():
    materials = Materials()
    curves = materials.mass_attenuation([20.0, 60.0, 100.0])
    np.testing.assert_allclose(curves, [NIST["water"], NIST["aluminium"], NIST["iron"]], rtol=0.02)
    u = np.linspace(0.0, 1.0, 5)
    shares = materials.mixture(u)
    np.testing.assert_allclose(shares.sum(axis=0), 1.0)
    np.testing.assert_allclose(materials.mixture(0.25), [0.5625, 0.375, 0.0625])
    assert Materials.of(("water", "Al", "Fe")).dense == "Fe"
    assert Materials.of(None) == materials
    assert hash(Materials("water", "Al", {"Fe": 1.0})) == hash(Materials("H2O", "aluminium", "iron"))


def test_detector_responses():
    energies = np.array([10.0, 60.0, 120.0])
    np.testing.assert_array_equal(Detector.photon_counting(threshold_kev=20.0).response(energies), [0, 1, 1])
    np.testing.assert_array_equal(Detector.energy_integrating(None).response(energies), energies)
    thick = Detector.energy_integrating("CsI", 100.0).response(energies)
    np.testing.assert_allclose(thick, energies, rtol=1e-6)
    thin = Detector.energy_integrating("CsI", 1e-6).response(energies)
    np.testing.assert_allclose(thin, energies * 4.51e-6 * mass_attenuation("CsI", energies), rtol=1e-3)
    with pytest.raises(ValueError, match="thickness_cm"):
        Detector.energy_integrating("CsI", 0.0)
    with pytest.raises(ValueError, match="sensor"):
        Detector.photon_counting(thickness_cm=0.1)


@pytest.mark.parametrize(
    "one, other, same",
    [
        ("aluminum", "aluminium", True),
        ("Al", "Aluminium", True),
        ({"Al": 1.0}, "aluminium", True),
        ("titanium", "aluminium", False),
        # The density of the first material is what an object that is made of it is measured by.
        ({"Al": 0.5, "Cu": 0.5}, "aluminium", False),
        ("graphite carbon", "carbon", False),
    ],
)
def test_materials_are_the_same_however_they_are_spelt(one, other, same):
    first, second = Materials(one, "bone", "iron"), Materials(other, "bone", "iron")
    assert (first == second) == same and (first != second) != same
    assert not same or hash(first) == hash(second)
    assert Materials("H2O", "Al", {"Fe": 1.0}) == Materials() != ("water", "aluminium", "iron")
