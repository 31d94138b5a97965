"""Counts into line integrals: exact where they can be trusted, marked and counted where not."""

import time

import numpy as np
import pytest

from tomo_polysplat.scan.defects import attenuation, fill_invalid, flat_and_dark, unusable


def test_counts_become_line_integrals_and_bad_rays_are_marked_and_counted():
    lines = np.linspace(0, 4, 2 * 3 * 5).reshape(2, 3, 5)
    white = np.full((4, 3, 5), 60000.0)
    white[0], white[1] = 50000.0, 70000.0  # only their mean counts
    dark = np.full((3, 5), 500.0)
    counts = np.round(500 + 59500 * np.exp(-lines)).astype(np.uint16)
    counts[0, 0, 0], counts[0, 1, 1], counts[1, 2, 2] = 400, 500, 65535  # below dark, no light, saturated
    white[:, 2, 4] = 500.0  # a dead pixel: as much light as without any
    flat, background = flat_and_dark(white, dark, (3, 5))
    found, valid, lost = attenuation(counts, "counts", flat, background)
    expected = np.ones((2, 3, 5), bool)
    expected[[0, 0, 1], [0, 1, 2], [0, 1, 2]] = False
    expected[:, 2, 4] = False
    np.testing.assert_array_equal(valid, expected)
    assert lost == {"not_finite": 0, "saturated": 1, "dead_pixel": 2, "no_light": 2}
    # Rounding to whole counts is worth exp(P) / 59500 / 2 at most.
    np.testing.assert_allclose(found[valid], lines[valid], atol=0.6 * np.exp(4) / 59500)
    assert unusable(counts, "counts", flat, background) == lost
    lightless = np.zeros_like(expected)
    lightless[0, [0, 1], [0, 1]] = True
    np.testing.assert_array_equal(np.isposinf(found), lightless)
    assert np.isfinite(found[~lightless]).all()


def test_negative_line_integrals_of_noisy_air_are_kept():
    found, valid, lost = attenuation(np.array([[[1.02, 0.5, np.nan]]]), "transmission")
    np.testing.assert_allclose(found[valid], [-np.log(1.02), np.log(2)], rtol=1e-6)
    assert valid.tolist() == [[[True, True, False]]] and lost["not_finite"] == 1


def test_holes_are_filled_linearly_along_the_detector_row():
    straight = np.tile(np.arange(9.0), (2, 3, 1))
    valid = np.ones(straight.shape, bool)
    valid[0, 1, 3:6] = valid[1, 2] = False
    damaged = np.where(valid, straight, -77)
    filled = fill_invalid(damaged, valid)
    expected = straight.copy()
    expected[1, 2] = 0
    np.testing.assert_allclose(filled, expected)
    assert (damaged[~valid] == -77).all(), "the input was changed"


@pytest.mark.parametrize("dtype", ["f4", "f8", ">f4", "f2"])
@pytest.mark.parametrize("share", [0.02, 0.4, 0.97])
def test_holes_are_filled_as_numpy_interpolates(dtype, share):
    """Bit for bit, in whatever order the array lies; NaN where there was no measurement does not spread."""
    rng = np.random.default_rng(3)
    valid = rng.random((7, 5, 23)) >= share
    values = np.where(valid, rng.normal(size=valid.shape), np.nan).astype(dtype).transpose(1, 0, 2)
    valid = valid.transpose(1, 0, 2)
    filled = fill_invalid(values, valid)
    column = np.arange(23)
    for row in np.ndindex(5, 7):
        good = valid[row]
        expected = np.interp(column, column[good], values[row][good]) if good.any() else np.zeros(23)
        np.testing.assert_array_equal(filled[row], expected.astype(filled.dtype))


def test_a_dead_column_costs_little():
    """Ten thousand rows are bridged in milliseconds; as many calls from Python take a twentieth of a second."""
    values = np.ones((10_000, 64), np.float32)
    valid = np.ones(values.shape, bool)
    valid[:, 9] = False
    fill_invalid(values[:1], valid[:1])  # compiles
    seconds = []
    for _ in range(3):
        begun = time.perf_counter()
        fill_invalid(values, valid)
        seconds.append(time.perf_counter() - begun)
    assert min(seconds) < 0.02


@pytest.mark.parametrize("dtype", [np.uint16, np.uint8, np.float32])
@pytest.mark.parametrize("saturation", [None, 90.0])
def test_bad_rays_are_counted_alike_with_and_without_line_integrals(dtype, saturation):
    """Each kind once at least, and rays that are of several kinds, of which the first counts."""
    rng = np.random.default_rng(5)
    counts = rng.integers(0, 100, (3, 7, 11)).astype(dtype)
    flat, dark = rng.uniform(60, 120, (7, 11)), rng.uniform(0, 5, (7, 11))
    flat[2, 3], flat[4], dark[5, 6] = np.nan, 1.0, np.nan
    counts[0, 4] = 99
    if dtype is np.float32:
        counts[1, :2], counts[2, 3] = np.nan, np.inf
    found = unusable(counts, "counts", flat, dark, saturation)
    assert found == attenuation(counts, "counts", flat, dark, saturation)[2]
    assert found["dead_pixel"] and found["no_light"] and (saturation is None or found["saturated"])


@pytest.mark.parametrize("kind", ["transmission", "attenuation"])
def test_other_rays_are_counted_alike(kind):
    values = np.array([[[0.5, np.nan, -1.0, 0.0, np.inf, 2.0]]])
    assert unusable(values, kind) == attenuation(values, kind)[2]
