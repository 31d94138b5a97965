"""Spectrum, scatter and noise of the simulated detector."""

import numpy as np
import pytest

from tomo_polysplat.simulate.scanner import Scanner, transmission


def test_one_energy_is_beer_lambert():
    areal = np.random.default_rng(0).uniform(0, 5, (4, 6, 2))
    passed = transmission(areal, np.array([[0.2], [1.1]]), np.array([1.0]))
    projection, valid = Scanner(noise=False).projection(Scanner(noise=False).counts(passed, 0))
    np.testing.assert_allclose(projection, areal @ [0.2, 1.1], rtol=1e-12)
    assert valid.all()


def test_many_energies_are_summed_and_harden():
    attenuation, weights = np.array([[2.0, 0.5, 0.1]]), np.array([0.2, 0.3, 0.5])
    thickness = np.linspace(0, 40, 5001)[:, None]  # more rays than one block holds
    projection = -np.log(transmission(thickness, attenuation, weights))
    assert projection[0] == 0.0
    slope = np.diff(projection) / np.diff(thickness[:, 0])
    assert slope[0] == pytest.approx(weights @ attenuation[0], rel=1e-2)  # thin: the mean attenuation
    assert slope[-1] == pytest.approx(0.1, rel=1e-3)  # thick: only the hardest quanta are left
    assert np.all(np.diff(slope) < 1e-9)


def test_counts_have_the_stated_mean_and_variance():
    passed = np.full((200, 500), 0.02)
    counts = Scanner(photons=1e4, electronic_noise=5.0, scatter=0.01).counts(passed, 3)
    mean, variance = 1e4 * 0.03, 1e4 * 0.03 + 25.0
    assert counts.mean() == pytest.approx(mean, abs=5 * np.sqrt(variance / counts.size))
    assert counts.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / counts.size))


def test_log_noise_follows_the_counts():
    """The standard deviation of a line integral is 1 / sqrt(counts) where counts are many."""
    scanner = Scanner(photons=1e5, electronic_noise=0.0)
    projection, _ = scanner.projection(scanner.counts(np.full(100_000, np.exp(-2.0)), 0))
    assert projection.mean() == pytest.approx(2.0, abs=1e-3)
    assert projection.std() == pytest.approx(1 / np.sqrt(1e5 * np.exp(-2.0)), rel=0.02)


def test_seed_and_view_fix_the_noise():
    passed = np.full((8, 9), 0.5)
    first = Scanner(seed=4).counts(passed, 2)
    np.testing.assert_array_equal(first, Scanner(seed=4).counts(passed, 2))
    assert not np.array_equal(first, Scanner(seed=5).counts(passed, 2))
    assert not np.array_equal(first, Scanner(seed=4).counts(passed, 3))


def test_scatter_lowers_line_integrals_most_where_they_are_large():
    passed = np.exp(-np.array([0.0, 2.0, 6.0]))
    clean, hazy = Scanner(noise=False), Scanner(noise=False, scatter=0.01)
    drop = clean.projection(clean.counts(passed, 0))[0] - hazy.projection(hazy.counts(passed, 0))[0]
    np.testing.assert_allclose(drop, np.log1p(0.01 / passed), rtol=1e-12)
    assert np.all(np.diff(drop) > 0)


def test_starved_pixels_are_finite_and_marked():
    scanner = Scanner(photons=1000.0, electronic_noise=0.0)
    projection, valid = scanner.projection(scanner.counts(np.array([1.0, 1e-12, 0.5]), 0))
    np.testing.assert_array_equal(valid, [True, False, True])
    assert projection[1] == pytest.approx(np.log(1000.0))


@pytest.mark.parametrize(
    "setting", [{"photons": 0.0}, {"photons": 1e30}, {"electronic_noise": -1.0}, {"scatter": np.nan}]
)
def test_impossible_scanners_are_refused(setting):
    with pytest.raises(ValueError, match=next(iter(setting))):
        Scanner(**setting)


@pytest.mark.parametrize("scatter", [5.0, 1.01, -0.1])
def test_scatter_is_a_share_of_the_open_beam(scatter):
    with pytest.raises(ValueError, match=r"scatter: .*<= 1.*0\.05 for 5 %"):
        Scanner(scatter=scatter)
