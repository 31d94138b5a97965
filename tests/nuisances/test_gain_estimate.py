"""Gains and drift out of residuals whose true parts are known."""

import numpy as np
import pytest

from tomo_polysplat.nuisances.drift import Drift
from tomo_polysplat.nuisances.gain_estimate import drift_of_views, gains_of_pixels
from tomo_polysplat.nuisances.gains import Gains

BLOCKS, ROWS, COLUMNS, VIEWS = 8, 37, 45, 61
RNG = np.random.default_rng(0)
GAINS = RNG.normal(0, 0.01, (ROWS, COLUMNS))


def noise_of(deviation, shape=(BLOCKS, ROWS, COLUMNS)):
    """Means of blocks that have this standard error together."""
    return np.random.default_rng(1).normal(0, deviation * BLOCKS**0.5, shape)


def found(parts, weight=None, axis=np.nan):
    weight = np.ones(np.shape(parts)) if weight is None else weight
    return gains_of_pixels(weight, weight * parts, axis)


def smooth():
    v, u = np.mgrid[-1 : 1 : ROWS * 1j, -1 : 1 : COLUMNS * 1j]
    return 0.02 * np.cos(2.2 * u + 0.4) * np.cos(1.7 * v)


def test_white_gains_are_found_beyond_the_noise():
    of = found(GAINS + noise_of(0.002))
    assert np.std(of - GAINS) < 0.003
    assert abs(of.mean()) < 1e-9


@pytest.mark.parametrize("deviation", [0.002, 0.02])
def test_noise_alone_is_no_gain(deviation):
    assert np.std(found(noise_of(deviation))) < 0.25 * deviation


def test_a_mean_is_shrunk_where_noise_is_as_strong():
    of = found(GAINS + noise_of(0.01))
    # Of gains and noise alike half is believed, and half of the variance is left: no estimate leaves less.
    assert np.std(of) < 0.8 * 0.01 and np.std(of - GAINS) < 0.8 * 0.01


def test_what_neighbours_have_in_common_is_left_to_the_object():
    assert np.std(found(smooth() + noise_of(0.001))) < 0.1 * np.std(smooth())
    both = found(GAINS + smooth() + noise_of(0.001))
    assert np.std(both - GAINS) < 0.5 * np.std(smooth())


def test_pixels_that_no_ray_tells_have_no_gain():
    weight = np.ones((BLOCKS, ROWS, COLUMNS))
    weight[:, 5:9, 7:20] = 0.0
    of = found(GAINS + noise_of(0.001), weight)
    assert not of[5:9, 7:20].any() and np.isfinite(of).all()
    assert not found(noise_of(0.01), np.zeros_like(weight)).any()


def test_a_detector_of_one_row_has_gains_as_well():
    gains = np.random.default_rng(3).normal(0, 0.02, (1, 91))
    of = found(gains + noise_of(0.001, (BLOCKS, 1, 91)))
    assert np.std(of - gains) < 0.4 * np.std(gains)


def test_the_drift_is_told_by_the_rays_that_are_missed_least():
    drift = 0.02 * np.cumsum(RNG.normal(0, 1, VIEWS)) / VIEWS**0.5
    drift -= drift.mean()
    count = np.full((2, VIEWS, 3), 100.0)
    # Air is known to 0.0003; behind the object the model is off, by another amount in each view and half.
    missed = RNG.normal(0, [0.0003, 0.02, 0.05], (2, VIEWS, 3)) + [0.0, 0.1, -0.2]
    of = drift_of_views(count, count * (drift[:, None] + missed))
    assert np.std(of - drift) < 0.0005 and abs(of.mean()) < 1e-9


def test_views_without_drift_stay():
    count = np.full((2, VIEWS, 3), 100.0)
    noise = RNG.normal(0, 0.001, (2, VIEWS, 3))
    assert np.std(drift_of_views(count, count * noise)) < 0.00025
    assert not drift_of_views(0 * count, 0 * count).any()


@pytest.mark.parametrize("kind", [Gains, Drift])
def test_only_what_explains_unseen_rays_beyond_chance_is_kept(kind):
    assert kind.gate({"rms": 0.01, "better": 0.1, "error": 0.02}).kept
    for evidence in ({"better": 0.05}, {"rms": 0.0}, {"better": float("nan")}):
        assert not kind.gate({"rms": 0.01, "better": 0.1, "error": 0.02} | evidence).kept
    assert "1.00%" in kind.told({kind.name: 0.01})


def both_parts(gains):
    """What opposite pixels have in common, and what they have not, of a detector whose axis is in the middle."""
    return 0.5 * (gains + gains[:, ::-1]), 0.5 * (gains - gains[:, ::-1])


MIDDLE = 0.5 * (COLUMNS - 1)


def test_what_differs_between_opposite_pixels_is_no_ring_and_stays():
    of = found(GAINS + noise_of(1e-5), axis=MIDDLE)
    (common, apart), (of_common, of_apart) = both_parts(GAINS), both_parts(of)
    assert np.std(of_apart - apart) < 0.1 * np.std(apart)
    assert np.std(of_common - common) < 0.2 * np.std(common)


def test_rings_that_are_stronger_than_gains_are_left_to_the_object():
    ring = 0.03 * np.random.default_rng(4).normal(size=(ROWS, COLUMNS))
    ring = both_parts(ring)[0]
    told = both_parts(GAINS)
    common, apart = both_parts(found(GAINS + ring + noise_of(1e-5), axis=MIDDLE))
    assert np.std(apart - told[1]) < 0.1 * np.std(apart)
    # Wiener's filter leaves s^2 r^2 / (s^2 + r^2) of a strength s^2 among r^2, where both are as strong for all waves.
    s2, r2 = np.mean(told[0] ** 2), np.mean(ring**2)
    assert np.mean((common - told[0]) ** 2) < 1.2 * s2 * r2 / (s2 + r2)


def test_rings_alone_are_no_gains():
    ring = both_parts(GAINS)[0]
    assert np.std(found(ring + noise_of(1e-5), axis=MIDDLE)) < 0.1 * np.std(ring)


def test_short_rings_are_told_from_gains_only_by_the_other_side():
    # A ring of every other column: waves that gains have as well.
    ring = np.where(np.abs(np.arange(COLUMNS) - MIDDLE) % 2 < 1, 0.02, -0.02) * np.ones((ROWS, 1))
    with_it = found(GAINS + ring + noise_of(1e-4), axis=MIDDLE)
    assert np.std(with_it - GAINS) < 0.35 * np.std(ring)


def test_a_pixel_without_another_one_keeps_what_is_no_stronger_than_gains():
    # The axis lies near the edge: few pixels have another.
    assert np.std(found(GAINS + noise_of(1e-5), axis=8.0) - GAINS) < 0.25 * np.std(GAINS)
    beside = GAINS.copy()
    beside[:, 17:] *= 6
    assert np.std(found(beside + noise_of(1e-5), axis=8.0)[:, 17:]) < 0.4 * np.std(beside[:, 17:])
    # Beyond the detector nothing tells, as where no view sees an axis.
    assert np.array_equal(found(GAINS + noise_of(1e-5), axis=-20.0), found(GAINS + noise_of(1e-5)))
