"""A spectrum for each pixel: nodes behind a filter, and rays seen as if it were not there, against the definition."""

import numpy as np
import pytest
import torch

from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.filter_map import FilterMap, measured_filter, require_filter_map
from tomo_polysplat.physics.materials import density, mass_attenuation
from tomo_polysplat.physics.quadrature import fit_quadrature
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.transmission import polychromatic_projection

SPECTRUM = Spectrum.from_tube(80, filters={"Al": 0.05})


def measured(areal, filters, material, curves=3, spectrum=SPECTRUM):
    """The definition: -log of what passes object and filter, less that of the filter alone."""
    object_ = Materials().mass_attenuation(spectrum.energies)[:curves]
    own = mass_attenuation(material, spectrum.energies)
    passed = np.exp(-np.tensordot(areal, object_, (0, 0)) - filters[..., None] * own) @ spectrum.weights
    return -np.log(passed / (np.exp(-filters[..., None] * own) @ spectrum.weights))


@pytest.mark.parametrize(("material", "thickest", "curves"), [("Al", 2.7, 3), ("Al", 2.7, 1), ("Cu", 0.4, 3)])
def test_few_nodes_hold_behind_every_thickness(material, thickest, curves):
    nodes = fit_quadrature(SPECTRUM, None, 6.0, curves=curves, behind=(material, 0.0, thickest))
    assert nodes.nodes <= 12 and nodes.rms_error <= 5e-4
    rng = np.random.default_rng(2)
    mean = Materials().mass_attenuation(SPECTRUM.effective_energy)[:curves]
    areal = rng.dirichlet(np.full(curves, 0.6), 999).T / mean[:, None] * rng.uniform(0, 6, 999)
    filters = thickest * rng.random(999) ** 2
    exact = measured(areal, filters, material, curves)
    by_nodes = [
        polychromatic_projection(torch.tensor(part), nodes, torch.tensor(filters)).numpy()
        for part in (areal, 0 * areal)
    ]
    inside = exact < 6.0
    assert inside.sum() > 500
    assert np.abs(by_nodes[0] - by_nodes[1] - exact)[inside].max() < 1.5 * nodes.error_bound < 6e-3


def test_rays_of_water_as_if_without_the_filter():
    areal, water = np.linspace(0.3, 2.0, 3 * 5).reshape(3, 5) ** 2, np.linspace(0.0, 12.0, 4)
    seen = np.stack([measured(np.array([[w]]), areal, "Al", 1) for w in water])
    bare = [measured(np.array([[w]]), np.zeros(1), "Al", 1).item() for w in water]
    found = FilterMap("Al", areal.astype(np.float32), 2.7).as_if_bare(torch.tensor(seen), SPECTRUM, "water")
    np.testing.assert_allclose(found, np.broadcast_to(np.array(bare)[:, None, None], seen.shape), atol=2e-3)
    # Noise beside the object stays unbiased: what is below 0 goes by the slope there.
    thin = torch.tensor(seen[:1] + [[1e-3] * 5] * 3)
    turned = FilterMap("Al", areal.astype(np.float32), 2.7).as_if_bare(
        torch.cat([thin, -thin]), SPECTRUM, "water"
    )
    np.testing.assert_allclose(turned[1], -turned[0], rtol=0.05)
    assert torch.isnan(
        FilterMap("Al", areal.astype(np.float32), 2.7).as_if_bare(thin * np.nan, SPECTRUM, "water")
    ).all()


def test_what_passes_the_filter_alone():
    areal = np.array([[0.0, 0.1, 1.0], [2.0, 3.0, 5.0]], np.float32)
    own = mass_attenuation("Al", SPECTRUM.energies)
    exact = -np.log(np.exp(-areal[..., None] * own) @ SPECTRUM.weights)
    np.testing.assert_allclose(FilterMap("Al", areal, 2.7).dimmed(SPECTRUM), exact, atol=1e-4)


def test_a_map_from_open_beams_with_and_without():
    thickness = np.array([[0.0, 1.0, 4.0]])  # mm
    own = density("Al") * mass_attenuation("Al", SPECTRUM.energies)
    counts = 1e4 * np.exp(-0.1 * thickness[..., None] * own) @ SPECTRUM.weights
    material, found, grams = measured_filter("Al", counts, np.full((1, 3), 1e4), SPECTRUM, "mm")
    np.testing.assert_allclose(found, thickness, atol=1e-4)
    assert (material, grams) == ("Al", density("Al"))
    with pytest.raises(ValueError, match="counts above 0"):
        measured_filter("Al", counts, np.zeros((1, 3)), SPECTRUM)


def test_joined_pixels_have_the_mean_of_the_filter():
    areal = np.arange(15, dtype=np.float32).reshape(3, 5)
    np.testing.assert_array_equal(FilterMap("Al", areal, 2.7).joined(2, 2).areal, [[3.0, 5.0]])


def test_a_row_stands_for_all_and_mistakes_are_named():
    told = FilterMap.of(("Teflon", np.array([1.0, 2.0]), 2.0), "mm", 3, 2)
    np.testing.assert_allclose(told.areal, [[0.2, 0.4]] * 3)
    assert "0.1 to 0.2 cm of Teflon" in told.describe()
    for value, words in (
        (("Al", [[1.0, -1.0]]), "no negative value"),
        (("Al", [[np.nan, 1.0]]), "no NaN"),
        (("Unobtainium", [[1.0]]), "material"),
        (("Al", [[1.0]], 0.0), "density"),
    ):
        with pytest.raises(ValueError, match=words):
            require_filter_map(value)
    with pytest.raises(TypeError, match="filter_map"):
        require_filter_map("Al:0.1")
    with pytest.raises(ValueError, match=r"shape \(4, 3\)"):
        FilterMap.of(("Al", np.ones((3, 4))), "cm", 4, 3)
    with pytest.raises(ValueError, match="real unit"):
        FilterMap.of(("Al", np.ones((4, 3))), "pixel", 4, 3)
