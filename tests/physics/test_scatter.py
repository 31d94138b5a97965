"""Scattered light in the quadrature, made level in data, taken out of them, and found from rays."""

import numpy as np
import pytest
import torch

from tomo_polysplat.nuisances.scatter import ScatteredLight
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.beer_lambert import projection
from tomo_polysplat.physics.quadrature import fit_quadrature
from tomo_polysplat.physics.ray_estimates import FittedRays, estimate_scatter, matching_factor, misfit_left
from tomo_polysplat.physics.scatter import (
    LARGEST_SCATTER,
    Scatter,
    add_scatter,
    light_around,
    made_level,
    without_scatter,
)
from tomo_polysplat.physics.spectral_change import with_voltage
from tomo_polysplat.physics.spectrum import Spectrum

MATERIALS = Materials()
SPECTRUM = Spectrum.from_tube(90, filters={"Al": 0.1})


def every_energy(spectrum):
    return fit_quadrature(spectrum, MATERIALS, nodes=spectrum.energies.size)


def value_of(areal, quadrature):
    return projection(areal, quadrature.log_weights, quadrature.attenuation)


FULL = every_energy(SPECTRUM)


def rays(count=3001):
    rng = np.random.default_rng(3)
    areal = rng.uniform(0, 1, (3, count)) * np.array([[6.0], [0.5], [1.0]])
    areal[:, : count // 5] = 0.0  # air
    areal[1:, : count // 2] = 0.0  # no metal
    return areal


@pytest.mark.parametrize("scatter", [0.0, 0.02, 0.1])
def test_scatter_adds_to_what_passes(scatter):
    areal = rays()
    plain = value_of(areal, FULL)
    scattered = value_of(areal, add_scatter(FULL, scatter))
    np.testing.assert_allclose(np.exp(-scattered), np.exp(-plain) + scatter, rtol=1e-12)
    found = without_scatter(torch.from_numpy(scattered), scatter, 30.0)
    np.testing.assert_allclose(found, plain, rtol=1e-9, atol=1e-12)


def test_a_ray_with_less_signal_than_scatter_gets_the_largest_value():
    values = without_scatter(torch.tensor([5.0, np.nan]), 0.02, 12.0)
    assert float(values[0]) == pytest.approx(12.0) and torch.isnan(values[1])


@pytest.mark.parametrize(
    "scatter", [Scatter(), Scatter(0.02), Scatter(0.1), Scatter(0.005, 0.03), Scatter(0.06, -0.05)]
)
def test_scatter_is_found_although_the_matter_has_taken_some_of_it_up(scatter):
    areal, noise = rays(), np.random.default_rng(4)
    light = noise.uniform(0.3, 1.0, areal.shape[1])
    total = np.exp(-value_of(areal, FULL)) + beside(scatter, light)
    measured = -np.log(total) + noise.normal(0.0, 0.003, light.shape)
    measured[::97] += 1.0  # rays that nothing explains
    thinner = areal * np.array([[0.97], [1.02], [0.95]])
    found, _ = estimate_scatter(
        FittedRays(thinner, measured, np.ones_like(measured), light).under(SPECTRUM, MATERIALS)
    )
    assert found.varies == scatter.varies
    np.testing.assert_allclose(beside(found, light), beside(scatter, light), atol=1.5e-3)


@pytest.mark.parametrize(("scatter", "shows"), [(0.0, False), (0.001, True)])
@pytest.mark.parametrize("photons", [1e4, 1e6])
def test_faint_scatter_shows_behind_metal_beyond_the_noise_of_counts(scatter, shows, photons):
    """A thousandth of the open beam is most of the light behind a centimetre of iron, and nothing in front of it."""
    areal, noise = rays(), np.random.default_rng(6)
    areal[2, ::10] += 8.0
    counts = noise.poisson(photons * (np.exp(-value_of(areal, FULL)) + scatter))
    measured = -np.log(np.maximum(counts, 0.5) / photons)
    weight = 1 / np.sqrt(1 + np.exp(measured) / (photons * 0.015**2))
    sample = FittedRays(areal, measured, weight, np.ones_like(measured))
    found, _ = estimate_scatter(sample.under(SPECTRUM, MATERIALS))
    assert (misfit_left(sample.under(SPECTRUM, MATERIALS), Scatter(), found) < 0.97) == shows
    assert misfit_left(sample.under(SPECTRUM, MATERIALS), found, found) == 1.0


def test_scatter_shows_in_rays_that_are_straight_sums_too():
    depth, noise = np.linspace(0.0, 8.0, 501), np.random.default_rng(7)
    measured = -np.log(np.exp(-depth) + 0.001) + noise.normal(0.0, 0.003, 501)
    sample = FittedRays(0.97 * depth[None], measured, np.ones(501), np.ones(501))
    found, _ = estimate_scatter(sample.under(None, None))
    assert found.constant == pytest.approx(0.001, rel=0.05)
    assert misfit_left(sample.under(None, None), Scatter(), found) < 0.2


def test_rays_that_nothing_passes_tell_nothing():
    areal = np.concatenate([rays(), np.full((3, 5), 1e6)], axis=1)
    measured = value_of(rays(), FULL)
    measured = np.append(measured, np.full(5, 700.0))
    light = np.linspace(0.2, 1.0, len(measured))
    found, _ = estimate_scatter(
        FittedRays(areal, measured, np.ones_like(measured), light).under(SPECTRUM, MATERIALS)
    )
    assert not found.varies and found.constant < 1e-3


@pytest.mark.parametrize(("beam", "scatter"), [(0.98, 0.03), (1.02, 0.01), (1.0, 0.03), (0.98, 0.0)])
def test_another_beam_is_told_from_scatter_by_the_rays_that_it_makes_dimmer(beam, scatter):
    """Beside the object a beam of 0.98 with scatter of 0.03 is as bright as one of 1.01."""
    areal, noise = rays(), np.random.default_rng(9)
    light = noise.uniform(0.3, 1.0, areal.shape[1])
    measured = -np.log(beam * (np.exp(-value_of(areal, FULL)) + scatter)) + noise.normal(
        0.0, 0.003, light.shape
    )
    sample = FittedRays(areal * np.array([[0.98], [1.0], [1.02]]), measured, np.ones_like(measured), light)
    found, told = estimate_scatter(sample.under(SPECTRUM, MATERIALS), beam_free=True)
    assert not found.varies and found.constant == pytest.approx(scatter, abs=1e-3)
    assert told == pytest.approx(beam, abs=1e-3)
    held, open_field = estimate_scatter(sample.under(SPECTRUM, MATERIALS))
    assert open_field == 1.0
    left = misfit_left(sample.under(SPECTRUM, MATERIALS), Scatter(), held)
    left_by_both = misfit_left(sample.under(SPECTRUM, MATERIALS), Scatter(), found, beam_free=True)
    shown = ScatteredLight.shown(0.0, sample, SPECTRUM, MATERIALS)
    # The second is looked at only where it explains more.
    assert (left_by_both < 0.97 * left) == (beam != 1.0) == (len(shown) == 2)
    assert [one.left for one in shown] == [left, left_by_both][: len(shown)]


def test_faint_matter_tells_no_beam():
    """Light that bends upwards asks for as much scatter as may be, under a beam that makes up for it."""
    areal = 0.002 * rays()
    value = value_of(areal, FULL)
    sample = FittedRays(areal, value - 5.0 * value**2, np.ones_like(value), np.ones_like(value))
    scatter, beam = estimate_scatter(sample.under(SPECTRUM, MATERIALS), beam_free=True)
    assert scatter.constant == pytest.approx(LARGEST_SCATTER) and beam < 0.9
    assert len(ScatteredLight.shown(0.0, sample, SPECTRUM, MATERIALS)) == 1


def test_the_light_around_a_ray_is_a_mean_of_its_view():
    rng = np.random.default_rng(5)
    values = torch.from_numpy(rng.uniform(0.5, 1.5, (3, 41, 53)).astype(np.float32))
    values[1] = 1.0
    values[1, 4:9, 7:30] = torch.nan  # which rays are not used does not matter
    values[2, :, 26:] = 40.0
    light = light_around(values)
    assert light.shape == values.shape and torch.isfinite(light).all()
    mean = float(torch.exp(-values[0]).mean())
    np.testing.assert_allclose(light[0], mean, rtol=0.1)
    np.testing.assert_allclose(light[1], np.exp(-1.0), rtol=1e-5)
    # No light comes from the dark half, and where the other begins there is half as much as far from it.
    assert (light[2, :, 1:] <= light[2, :, :-1] + 1e-6).all()
    assert float(light[2, 20, 26]) == pytest.approx(0.5 * mean, rel=0.15)


def test_light_of_a_detector_of_one_row():
    values = torch.linspace(0.0, 2.0, 37).reshape(1, 1, 37)
    light = light_around(values)[0, 0]
    assert (light.diff() < 0).all() and float(light[18]) == pytest.approx(
        float(torch.exp(-values).mean()), rel=0.1
    )


@pytest.mark.parametrize("scatter", [Scatter(0.005, 0.03), Scatter(0.06, -0.05), Scatter(0.02)])
def test_scatter_made_level_is_the_same_everywhere(scatter):
    rng = np.random.default_rng(6)
    plain = torch.from_numpy(rng.uniform(0.0, 6.0, (5, 13, 17)).astype(np.float32))
    plain[0, 3, 4], light = torch.nan, light_around(plain)
    scattered = -torch.log(torch.exp(-plain) + scatter.at(light))
    scatter_of = scatter.at(light_around(scattered))
    made, level = made_level(scattered, scatter)
    expected = -torch.log(torch.exp(-scattered) - scatter_of + level)
    np.testing.assert_allclose(made, expected, rtol=1e-5, atol=1e-6)
    assert 0 <= level <= float(scatter_of[torch.isfinite(plain)].max()) + 1e-6
    kept = torch.isfinite(plain)
    assert torch.equal(torch.isfinite(made), kept)
    assert (torch.exp(-made)[kept] >= 0.89 * torch.exp(-scattered)[kept]).all()


def beside(scatter, light):
    return scatter.at(torch.from_numpy(light)).numpy()


@pytest.mark.parametrize("kvp", [81, 99])
def test_a_known_density_tells_the_voltage(kvp):
    """Rays of water of density 1 at 90 kV, fitted under another voltage, look like water of another density."""
    wrong = Spectrum.from_tube(kvp, filters={"Al": 0.1})
    one, other = (value_of(np.array([[1.0], [0], [0]]) * 3.0, every_energy(s)) for s in (SPECTRUM, wrong))
    density = float(one[0] / other[0])
    factor = matching_factor(with_voltage, wrong, "water", 6.0, 1 / density, (0.8, 1.25))
    assert factor * kvp == pytest.approx(90, abs=1.5)
