"""The torch projection against its definition, its gradient against differences, and the water inverse."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.physics.quadrature import fit_quadrature
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.transmission import polychromatic_projection
from tomo_polysplat.physics.water import areal_density, transmitted_energy, water_linearised

SPECTRUM = Spectrum.from_tube(90, filters={"Al": 0.1})
QUADRATURE = fit_quadrature(SPECTRUM, Materials(), 10.0)


def rays(*shape):
    rng = np.random.default_rng(11)
    return rng.uniform(0.0, 1.0, (3, *shape)) * np.array([20.0, 5.0, 3.0]).reshape(3, *[1] * len(shape))


def definition(areal):
    weighted = QUADRATURE.weights * np.exp(-np.moveaxis(areal, 0, -1) @ QUADRATURE.attenuation)
    return -np.log(weighted.sum(axis=-1))


@pytest.mark.parametrize("shape", [(), (7,), (3, 5), (2, 3, 5)])
def test_definition_in_any_shape(shape):
    areal = rays(*shape)
    value = polychromatic_projection(torch.from_numpy(areal), QUADRATURE)
    assert value.shape == shape
    np.testing.assert_allclose(value.numpy(), definition(areal), rtol=1e-12)


def test_float32_is_stable_for_opaque_rays():
    areal = 4.0 * rays(300)
    assert definition(areal).max() > 25
    value = polychromatic_projection(torch.from_numpy(areal.astype(np.float32)), QUADRATURE)
    assert value.dtype == torch.float32
    np.testing.assert_allclose(value.numpy(), definition(areal), rtol=2e-6)
    huge = torch.full((3, 2), 1e6, requires_grad=True)
    polychromatic_projection(huge, QUADRATURE).sum().backward()
    assert torch.isfinite(huge.grad).all()


def test_gradient():
    areal = torch.from_numpy(rays(4, 3)).requires_grad_()
    assert torch.autograd.gradcheck(lambda a: polychromatic_projection(a, QUADRATURE), (areal,), atol=1e-8)


def test_gradient_at_nothing_is_the_mean_attenuation():
    areal = torch.zeros(3, 1, dtype=torch.float64, requires_grad=True)
    value = polychromatic_projection(areal, QUADRATURE)
    value.sum().backward()
    assert abs(value.item()) < 1e-12
    np.testing.assert_allclose(areal.grad[:, 0].numpy(), QUADRATURE.mean_attenuation, rtol=1e-12)


def test_gradient_through_a_strided_view_and_a_weighted_loss():
    areal = torch.from_numpy(rays(6, 4)).requires_grad_()
    weights = torch.linspace(-1.0, 1.0, 12, dtype=torch.float64).reshape(4, 3)
    (polychromatic_projection(areal.transpose(1, 2)[:, :, ::2], QUADRATURE) * weights).sum().backward()
    reference = areal.detach().clone().requires_grad_()
    attenuation = torch.from_numpy(QUADRATURE.attenuation.copy())
    exponents = torch.from_numpy(QUADRATURE.log_weights.copy()) - torch.einsum(
        "kij,kn->ijn", reference, attenuation
    )
    (-exponents.logsumexp(-1).T[:, ::2] * weights).sum().backward()
    torch.testing.assert_close(areal.grad, reference.grad)


@pytest.mark.parametrize("shape", [(3,), (5, 23)])
@pytest.mark.parametrize("filtered", [False, True])
def test_rays_and_slopes_in_lanes_of_float32_are_those_of_float64(shape, filtered):
    curve = mass_attenuation("Al", np.linspace(30.0, 70.0, QUADRATURE.nodes))
    nodes = replace(QUADRATURE, filter=curve) if filtered else QUADRATURE
    behind = torch.rand(shape, generator=torch.Generator().manual_seed(1)) if filtered else None
    found = []
    for kind in (torch.float32, torch.float64):
        areal = torch.from_numpy(rays(*shape)).to(kind).requires_grad_()
        value = polychromatic_projection(areal, nodes, None if behind is None else behind.to(kind))
        (value * torch.arange(value.numel()).reshape(shape)).sum().backward()
        found.append((value.detach().double(), areal.grad.double()))
    for one, other in zip(*found):
        torch.testing.assert_close(one, other, rtol=3e-6, atol=1e-6)


def test_negative_areal_densities_stay_finite():
    areal = torch.tensor([[-3.0], [-1.0], [0.2]], requires_grad=True)
    value = polychromatic_projection(areal, QUADRATURE)
    value.sum().backward()
    assert torch.isfinite(value).all() and torch.isfinite(areal.grad).all()


def test_hardening_is_concave_and_monochromatic_is_linear():
    line = torch.linspace(0.0, 5.0, 50, dtype=torch.float64) * torch.tensor([[0.0], [0.0], [1.0]])
    value = polychromatic_projection(line, QUADRATURE).numpy()
    assert np.all(np.diff(value) > 0) and np.all(np.diff(value, 2) < 0)
    single = fit_quadrature(Spectrum.monochromatic(60.0), Materials(), 10.0)
    straight = polychromatic_projection(line, single).numpy()
    np.testing.assert_allclose(straight, line[2].numpy() * mass_attenuation("iron", 60.0), rtol=1e-12)


@pytest.mark.parametrize("wrong", [torch.zeros(2, 4), torch.zeros(()), torch.zeros(3, 4, dtype=torch.int64)])
def test_wrong_input(wrong):
    with pytest.raises(ValueError, match="areal"):
        polychromatic_projection(wrong, QUADRATURE)


@pytest.mark.parametrize(
    "spectrum", [SPECTRUM, Spectrum.from_tube(120), Spectrum.monochromatic(60.0)], ids=lambda s: s.label
)
def test_areal_density_inverts_the_projection(spectrum):
    water = np.concatenate([[0.0], np.geomspace(1e-3, 80.0, 200)])
    transmitted = np.exp(-np.outer(water, mass_attenuation("water", spectrum.energies))) @ spectrum.weights
    np.testing.assert_allclose(areal_density(-np.log(transmitted), spectrum), water, rtol=2e-5, atol=1e-12)


def test_water_linearised_is_the_scan_at_the_effective_energy():
    water = np.array([[0.5, 1.0], [5.0, 20.0]])
    curve = mass_attenuation("water", SPECTRUM.energies)
    measured = -np.log(np.exp(-np.multiply.outer(water, curve)) @ SPECTRUM.weights)
    expected = water * mass_attenuation("water", SPECTRUM.effective_energy)
    np.testing.assert_allclose(water_linearised(measured, SPECTRUM), expected, rtol=1e-6)
    assert np.abs(measured / expected - 1.0).max() > 0.02  # there was something to correct


def test_areal_density_of_noise_and_of_bad_pixels():
    slope = SPECTRUM.weights @ mass_attenuation("water", SPECTRUM.energies)
    np.testing.assert_allclose(areal_density([-0.2, -0.1], SPECTRUM), np.array([-0.2, -0.1]) / slope)
    kept = areal_density([np.nan, np.inf, 1.0], SPECTRUM)
    assert np.isnan(kept[0]) and kept[1] == np.inf and np.isfinite(kept[2])
    assert areal_density(np.float32(0.0), SPECTRUM) == 0.0
    assert areal_density(np.zeros((0, 4)), SPECTRUM).shape == (0, 4)


def test_water_of_a_tensor_is_that_of_an_array():
    values = np.array([[0.3, -0.2, np.nan], [np.inf, 0.0, 7.5]], np.float32)
    water = areal_density(torch.from_numpy(values), SPECTRUM)
    assert water.dtype == torch.float32
    np.testing.assert_allclose(water.numpy(), areal_density(values, SPECTRUM), rtol=1e-6)
    energies = transmitted_energy(values, SPECTRUM), transmitted_energy(torch.from_numpy(values), SPECTRUM)
    assert energies[0] == pytest.approx(energies[1], rel=1e-6)


@pytest.mark.parametrize("value", [1e-30, 1e-9, 1e-6])
def test_hardly_attenuated_rays_transmit_the_whole_spectrum(value):
    energy = transmitted_energy(np.array([value, 0.0]), SPECTRUM)
    assert energy == pytest.approx(SPECTRUM.weights @ SPECTRUM.energies, rel=1e-6)


def test_what_no_light_passes_hardens_to_the_last_energy():
    """Though every share of it is too small for a float."""
    assert transmitted_energy(np.array([2e3, 3e3]), SPECTRUM) == pytest.approx(90.0, abs=1.0)


@pytest.mark.parametrize("spare", [False, True])
def test_rays_are_overwritten_only_where_nobody_needs_them(spare):
    values = torch.linspace(-0.1, 4.0, 3 * 30_000, dtype=torch.float32).reshape(3, -1, 10)
    values[1, 5, 2] = torch.nan
    given, expected = values.clone(), areal_density(values.double().numpy(), SPECTRUM)
    found = areal_density(given, SPECTRUM, spare=spare)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    assert (found.data_ptr() == given.data_ptr()) == spare
    assert spare or torch.equal(given.nan_to_num(), values.nan_to_num())
