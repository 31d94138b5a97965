"""A constant scattered signal in the quadrature, taken out of data, and found from rays."""

import numpy as np
import pytest

from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.quadrature import sampled_quadrature
from tomo_polysplat.physics.ray_estimates import estimate_scatter, matching_factor
from tomo_polysplat.physics.scatter import add_scatter, without_scatter
from tomo_polysplat.physics.spectral_change import with_voltage
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.transmission import polychromatic_projection_numpy

MATERIALS = Materials()
SPECTRUM = Spectrum.from_tube(90, filters={"Al": 0.1})
FULL = sampled_quadrature(SPECTRUM, MATERIALS)


def rays(count=3001):
    rng = np.random.default_rng(3)
    areal = rng.uniform(0, 1, (3, count)) * np.array([[6.0], [0.5], [1.0]])
    areal[:, : count // 5] = 0.0  # air
    areal[1:, : count // 2] = 0.0  # no metal
    return areal


@pytest.mark.parametrize("scatter", [0.0, 0.02, 0.1])
def test_scatter_adds_to_what_passes(scatter):
    areal = rays()
    plain = polychromatic_projection_numpy(areal, FULL)
    scattered = polychromatic_projection_numpy(areal, add_scatter(FULL, scatter))
    np.testing.assert_allclose(np.exp(-scattered), np.exp(-plain) + scatter, rtol=1e-12)
    np.testing.assert_allclose(without_scatter(scattered, scatter, 30.0), plain, rtol=1e-9, atol=1e-12)


def test_a_ray_with_less_signal_than_scatter_gets_the_largest_value():
    values = without_scatter([5.0, np.nan], 0.02, 12.0)
    assert values[0] == 12.0 and np.isnan(values[1])


@pytest.mark.parametrize("scatter", [0.0, 0.02, 0.1])
def test_scatter_is_found_although_the_matter_has_taken_some_of_it_up(scatter):
    areal, noise = rays(), np.random.default_rng(4)
    measured = polychromatic_projection_numpy(areal, add_scatter(FULL, scatter))
    measured += noise.normal(0.0, 0.003, measured.shape)
    measured[::97] += 1.0  # rays that nothing explains
    thinner = areal * np.array([[0.97], [1.02], [0.95]])
    found = estimate_scatter(thinner, measured, np.ones_like(measured), SPECTRUM, MATERIALS)
    assert found == pytest.approx(scatter, abs=1e-3)


def test_rays_that_nothing_passes_tell_nothing():
    areal = np.concatenate([rays(), np.full((3, 5), 1e6)], axis=1)
    measured = polychromatic_projection_numpy(rays(), FULL)
    measured = np.append(measured, np.full(5, 700.0))
    assert estimate_scatter(areal, measured, np.ones_like(measured), SPECTRUM, MATERIALS) < 1e-3


@pytest.mark.parametrize("kvp", [81, 99])
def test_a_known_density_tells_the_voltage(kvp):
    """Rays of water of density 1 at 90 kV, fitted under another voltage, look like water of another density."""
    wrong = Spectrum.from_tube(kvp, filters={"Al": 0.1})
    one, other = (
        polychromatic_projection_numpy(np.array([[1.0], [0], [0]]) * 3.0, sampled_quadrature(s, MATERIALS))
        for s in (SPECTRUM, wrong)
    )
    density = float(one[0] / other[0])
    factor = matching_factor(with_voltage, wrong, "water", 6.0, 1 / density, (0.8, 1.25))
    assert factor * kvp == pytest.approx(90, abs=1.5)
