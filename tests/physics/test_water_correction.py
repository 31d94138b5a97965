"""A water correction undone: the inverse of a polynomial, and polynomials that have none."""

import tracemalloc

import numpy as np
import pytest

from tomo_polysplat.physics.water_correction import (
    describe_polynomial,
    require_water_correction,
    undo_water_correction,
)

SCANNERS = [(0.0, 1.0), (0.0, 1.0, 0.03), (0.0, 1.05, 0.02, 1e-3), (0.0, 0.9, -0.01), (0, 1, 0, 0.01, 2e-4)]


@pytest.mark.parametrize("coefficients", SCANNERS)
def test_it_is_the_inverse(coefficients):
    before = np.random.default_rng(5).uniform(-0.1, 9.0, (7, 13, 3))
    corrected = sum(c * before**k for k, c in enumerate(coefficients))
    np.testing.assert_allclose(undo_water_correction(corrected, coefficients), before, rtol=1e-12, atol=1e-12)


def test_the_identity_changes_nothing_and_rays_that_are_not_used_stay_so():
    values = np.array([0.0, 1.5, np.nan, np.inf, -0.01])
    np.testing.assert_allclose(undo_water_correction(values, (0.0, 1.0)), values, rtol=1e-14)
    assert np.isnan(undo_water_correction([np.nan], (0.0, 1.0))).all()


def test_noise_is_stretched_by_the_slope_alone():
    """To first order P changes by the change of the corrected value over the polynomial's slope."""
    coefficients, before = (0.0, 1.0, 0.05), np.linspace(0.1, 6.0, 11)
    corrected = before + 0.05 * before**2
    shifted = undo_water_correction(corrected + 1e-6, coefficients)
    np.testing.assert_allclose((shifted - before) / 1e-6, 1 / (1 + 0.1 * before), rtol=1e-4)


@pytest.mark.parametrize("values", [[0.0, 6.0], [-5.0, 1.0]])
def test_a_polynomial_that_turns_before_the_values_end_is_refused(values):
    """P - 0.05 P^2 has its largest value, 5, at P = 10; P + 0.1 P^2 its smallest, -2.5, at P = -5."""
    coefficients = (0.0, 1.0, -0.05) if values[1] > 5 else (0.0, 1.0, 0.1)
    with pytest.raises(ValueError, match="water_correction: expected a polynomial that rises"):
        undo_water_correction(values, coefficients)


def test_up_to_where_it_turns_a_polynomial_is_taken():
    coefficients = (0.0, 1.0, -0.05)
    np.testing.assert_allclose(undo_water_correction([4.9999], coefficients), 10 - np.sqrt(2e-3), rtol=1e-6)


def test_it_is_described_as_it_is_written():
    assert describe_polynomial((0.0, 1.0, -0.05)) == "1 P - 0.05 P^2"


@pytest.mark.parametrize(
    "wrong", [(1.0, 0.02), (0.0,), (), (0.0, -1.0), (0.0, 0.0, 1.0), (0.0, np.nan), "0 1", [[0.0, 1.0]], 1.0]
)
def test_wrong_coefficients(wrong):
    with pytest.raises((ValueError, TypeError), match="water_correction"):
        require_water_correction(wrong)


def test_a_large_scan_is_undone_in_little_more_memory_than_it_takes():
    values = np.linspace(0, 6, 1 << 23, dtype=np.float32)
    tracemalloc.start()
    undone = undo_water_correction(values, (0.0, 1.0, 0.03), np.float32)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_allclose(undone + 0.03 * undone.astype(np.float64) ** 2, values, rtol=1e-5, atol=1e-6)
    assert peak < 5 * values.nbytes
