"""Correlation by fineness, in closed cases."""

import numpy as np
import pytest

from tomo_polysplat.quality.fourier_shell import HALVES, TRUTH, first_below, shell_correlation
from tomo_polysplat.result.detail import ShellCorrelation

SIZE, EDGES = (21, 24, 23), (0.5, 0.5, 0.5)


def white(seed, shape=SIZE):
    return np.random.default_rng(seed).standard_normal(shape)


def low_pass(volume, width):
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(volume, width, mode="wrap")


def test_the_same_volume_correlates_in_full_whatever_its_height_and_blur():
    curve = shell_correlation(white(0), 3 * low_pass(white(0), 0.4) + 5, EDGES)
    assert curve.correlation == pytest.approx(np.ones(len(curve.correlation)), abs=0.02)
    assert curve.frequency[-1] == pytest.approx(1.0, rel=0.05), "half a cycle a voxel"
    assert first_below(curve, HALVES) is None


def test_other_volumes_do_not_correlate():
    assert np.abs(shell_correlation(white(1), white(2), EDGES).correlation).max() < 0.35


def test_as_much_noise_as_signal_in_both_leaves_a_half():
    curve = shell_correlation(white(0) + white(1), white(0) + white(2), EDGES)
    assert curve.correlation[2:] == pytest.approx(np.full(len(curve.correlation) - 2, 0.5), abs=0.12)


@pytest.mark.parametrize("shape", [(32, 33, 34), (1, 96, 97)])
def test_halves_at_a_seventh_tell_where_all_of_it_is_half_right(shape):
    """A signal that falls with frequency, and white noise, which the mean of two halves has half the variance of."""
    signal = 12 * low_pass(white(0, shape), [1.5 if n > 1 else 0 for n in shape])
    halves = [signal + white(k, shape) for k in (1, 2)]
    told = first_below(shell_correlation(*halves, EDGES), HALVES)
    true = first_below(shell_correlation(sum(halves) / 2, signal, EDGES), TRUTH)
    assert 0.2 < true < 0.8 and told == pytest.approx(true, rel=0.08)


def test_where_a_line_crosses_a_level():
    curve = ShellCorrelation(np.array([1.0, 2.0, 3.0, 4.0]), np.array([1.0, np.nan, 0.6, 0.1]))
    assert first_below(curve, 0.35) == pytest.approx(3.5) and first_below(curve, 0.05) is None


def test_voxels_that_are_no_cubes_are_compared_as_far_as_the_longest_edge_goes():
    curve = shell_correlation(white(0), white(0), (0.5, 0.5, 1.0))
    assert curve.frequency[-1] == pytest.approx(0.5, rel=0.06)
