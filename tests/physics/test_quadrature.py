"""Few nodes against the full spectrum, on rays drawn independently of the fit."""

import numpy as np
import pytest

from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.quadrature import fit_quadrature
from tomo_polysplat.physics.spectrum import Spectrum

MATERIALS = Materials()
TUBES = {
    "90 kVp": Spectrum.from_tube(90, filters={"Al": 0.1}),
    "120 kVp": Spectrum.from_tube(120, filters={"Al": 0.2}),
    "bare 120 kVp": Spectrum.from_tube(120),
    "225 kVp": Spectrum.from_tube(225, filters={"Cu": 0.05}),
}


def exact(areal, spectrum, materials=MATERIALS):
    """The definition, written out: P of areal densities (3, rays)."""
    transmitted = np.exp(-areal.T @ materials.mass_attenuation(spectrum.energies)) @ spectrum.weights
    return -np.log(transmitted)


def approximate(areal, quadrature):
    return -np.log(np.exp(quadrature.log_weights - areal.T @ quadrature.attenuation).sum(axis=1))


def random_rays(spectrum, largest, materials=MATERIALS, count=2000):
    """Random mixtures whose P lies below ``largest``."""
    rng = np.random.default_rng(7)
    curves = materials.mass_attenuation(spectrum.effective_energy)
    areal = rng.dirichlet([0.6, 0.6, 0.6], count).T / curves * rng.uniform(0.0, 2.0 * largest, count)
    return areal[:, exact(areal, spectrum, materials) <= largest]


@pytest.mark.parametrize("tube", TUBES)
@pytest.mark.parametrize("largest", [5.0, 15.0])
def test_errors_are_as_stated(tube, largest):
    spectrum = TUBES[tube]
    quadrature = fit_quadrature(spectrum, MATERIALS, largest)
    rays = random_rays(spectrum, largest)
    assert rays.shape[1] > 500
    errors = approximate(rays, quadrature) - exact(rays, spectrum)
    # Random rays are not the ones the bound comes from, so a little more than it is fair.
    assert np.abs(errors).max() <= 1.1 * quadrature.error_bound
    assert quadrature.rms_error <= 5e-4
    assert np.sqrt(np.mean(errors**2)) <= 1e-3
    assert quadrature.nodes <= 12
    assert quadrature.weights.sum() == pytest.approx(1.0, abs=1e-12)
    assert np.all(quadrature.attenuation > 0)


@pytest.mark.parametrize("tube", TUBES)
def test_thin_objects_keep_their_attenuation(tube):
    spectrum = TUBES[tube]
    quadrature = fit_quadrature(spectrum, MATERIALS, 8.0)
    mean = MATERIALS.mass_attenuation(spectrum.energies) @ spectrum.weights
    np.testing.assert_allclose(quadrature.mean_attenuation, mean, rtol=1e-3)
    thin = 1e-6 / mean[:, None] * np.eye(3)
    np.testing.assert_allclose(approximate(thin, quadrature), exact(thin, spectrum), rtol=2e-3)


def test_five_fitted_nodes_beat_many_samples():
    spectrum = TUBES["90 kVp"]
    rays = random_rays(spectrum, 5.0)
    target = exact(rays, spectrum)

    def rms(quadrature):
        return np.sqrt(np.mean((approximate(rays, quadrature) - target) ** 2))

    fitted = rms(fit_quadrature(spectrum, MATERIALS, 5.0, nodes=5))
    sampled = [rms(fit_quadrature(spectrum.sampled(n), MATERIALS, 5.0, nodes=n)) for n in (63, 15)]
    assert fitted < 0.5 * sampled[0] and fitted < 0.05 * sampled[1]


def test_error_falls_with_nodes_and_nodes_follow_the_tolerance():
    spectrum = TUBES["90 kVp"]
    errors = [fit_quadrature(spectrum, MATERIALS, 8.0, nodes=n).rms_error for n in (1, 2, 3, 4, 5, 6, 7)]
    assert np.all(np.diff(errors) < 0)
    loose = fit_quadrature(spectrum, MATERIALS, 8.0, tolerance=1e-2)
    tight = fit_quadrature(spectrum, MATERIALS, 8.0, tolerance=1e-4)
    assert loose.nodes < tight.nodes
    assert loose.rms_error <= 1e-2 and tight.rms_error <= 1e-4


def test_unreachable_tolerance_keeps_every_energy():
    spectrum = TUBES["90 kVp"]
    quadrature = fit_quadrature(spectrum, MATERIALS, 8.0, tolerance=1e-12)
    assert quadrature.nodes == np.count_nonzero(spectrum.weights)
    assert quadrature.error_bound == 0.0


@pytest.mark.parametrize(
    "materials",
    [Materials("water", "iodine", "BaSO4"), Materials("Ag", "Sn", "Au"), Materials(*["water"] * 3)],
)
def test_edges_and_repeated_materials(materials):
    spectrum = TUBES["90 kVp"]
    quadrature = fit_quadrature(spectrum, materials, 8.0)
    rays = random_rays(spectrum, 8.0, materials)
    errors = approximate(rays, quadrature) - exact(rays, spectrum, materials)
    assert rays.shape[1] > 500
    assert np.sqrt(np.mean(errors**2)) <= 1e-3
    assert quadrature.nodes <= 16


@pytest.mark.parametrize("kev", [10.0, 60.0])
def test_a_single_energy_is_exact(kev):
    quadrature = fit_quadrature(Spectrum.monochromatic(kev), MATERIALS, 8.0)
    assert quadrature.nodes == 1
    assert quadrature.error_bound == 0.0
    np.testing.assert_array_equal(quadrature.attenuation, MATERIALS.mass_attenuation([kev]))


def test_range_as_areal_densities():
    spectrum = TUBES["120 kVp"]
    quadrature = fit_quadrature(spectrum, MATERIALS, (20.0, 5.0, 0.0))
    rays = np.random.default_rng(3).uniform(0.0, 1.0, (3, 500)) * np.array([[20.0], [5.0], [0.0]])
    errors = approximate(rays, quadrature) - exact(rays, spectrum)
    assert np.abs(errors).max() <= 1.1 * quadrature.error_bound
    assert "g/cm2" in quadrature.describe()


def test_same_input_same_nodes():
    first, second = (fit_quadrature(TUBES["225 kVp"], MATERIALS, 6.0) for _ in range(2))
    np.testing.assert_array_equal(first.attenuation, second.attenuation)
    np.testing.assert_array_equal(first.log_weights, second.log_weights)


def test_every_energy_as_a_node_is_the_definition():
    spectrum = TUBES["90 kVp"]
    rays = random_rays(spectrum, 8.0)
    full = fit_quadrature(spectrum, MATERIALS, nodes=spectrum.energies.size)
    np.testing.assert_allclose(approximate(rays, full), exact(rays, spectrum), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("wrong", [0.0, -1.0, np.nan, np.inf, (1.0, 2.0), (0.0, 0.0, 0.0), (1.0, -1.0, 1.0)])
def test_wrong_range(wrong):
    with pytest.raises(ValueError, match="max_path"):
        fit_quadrature(TUBES["90 kVp"], MATERIALS, wrong)
    with pytest.raises(ValueError, match="nodes"):
        fit_quadrature(TUBES["90 kVp"], MATERIALS, 8.0, nodes=0)


@pytest.mark.parametrize("largest", [0.02, 1.0, 10.0])
def test_nodes_of_one_curve_hold_for_its_own_rays(largest):
    spectrum = TUBES["90 kVp"]
    one, three = (fit_quadrature(spectrum, MATERIALS, largest, curves=k) for k in (1, 3))
    areal = np.random.default_rng(3).uniform(0, 5 * largest, (1, 500))
    truth = exact(np.concatenate([areal, 0 * areal, 0 * areal]), spectrum)
    keep = truth <= largest
    assert keep.sum() > 50 and one.attenuation.shape == (1, one.nodes)
    assert np.abs(approximate(areal, one) - truth)[keep].max() <= 1.1 * one.error_bound <= 2e-3
    assert one.nodes <= three.nodes and (one.nodes == 1) == (largest < 0.1)


def test_more_nodes_than_the_fewest_can_be_asked_for():
    """Even many more than rays of one material at a few levels would settle."""
    for curves in (1, 3):
        asked = fit_quadrature(TUBES["90 kVp"], MATERIALS, 3.0, nodes=25, curves=curves)
        assert 4 < asked.nodes <= 25 and asked.error_bound < 5e-4


@pytest.mark.parametrize("value", [0.1, 2.0, 8.0])
def test_the_straight_line_is_the_ray_without_hardening(value):
    spectrum = TUBES["90 kVp"]
    quadrature = fit_quadrature(spectrum, MATERIALS, 10.0)
    line = quadrature.straight_line(value)
    water = line / (MATERIALS.mass_attenuation(spectrum.energies)[0] @ spectrum.weights)
    # As far as the nodes hold.
    assert exact(np.array([[water], [0], [0]]), spectrum)[0] == pytest.approx(value, abs=5e-3)
    assert line > value
