"""A saturated camera holds one value in an area beside the object; scans that are not saturated stay as they are."""

import logging

import numpy as np
import pytest

from tomo_polysplat.scan.light_end import lower_end, mend_light_end

VIEWS, ROWS, COLUMNS, PHOTONS = 24, 12, 40, 1e4


def counts(seed=0):
    """A ball off the axis, with Poisson noise, (views, rows, columns)."""
    angles = np.linspace(0, 2 * np.pi, VIEWS, endpoint=False)[:, None, None]
    across = np.arange(COLUMNS)[None, None] - 19.5 - 4 * np.cos(angles)
    down = np.arange(ROWS)[None, :, None] - 5.5
    chord = 2 * np.sqrt(np.clip(64 - across**2 - down**2, 0, None))
    return np.random.default_rng(seed).poisson(PHOTONS * np.exp(-0.1 * chord)), chord


def logarithms(light, flat=PHOTONS):
    return -np.log(light / flat).astype(np.float32)


def test_saturated_rays_pass_beside_the_object_but_at_the_border(caplog):
    light, chord = counts()
    values = logarithms(np.minimum(light, 0.8 * PHOTONS))
    with caplog.at_level(logging.WARNING):
        assert mend_light_end(values) > 0
    assert "saturated" in caplog.text and "less light" in caplog.text
    zero = values == 0
    assert (chord[zero] == 0).mean() > 0.95 and zero.mean() > 0.3
    assert np.isnan(values).any()
    kept = np.isfinite(values) & ~zero
    np.testing.assert_array_equal(values[kept], logarithms(light)[kept])


@pytest.mark.parametrize(
    "kind",
    [
        "noise",
        "cut at the mean",
        "without noise",
        "without noise, air 0 to rounding",
        "noise of matter alone",
        "one ray",
    ],
)
def test_a_scan_that_is_not_saturated_is_left_alone(kind, caplog):
    light, chord = counts()
    values = logarithms(light)
    if kind == "cut at the mean":
        values = np.maximum(values, 0)
    elif kind == "without noise":
        values = (0.1 * chord).astype(np.float32)
    elif kind == "without noise, air 0 to rounding":
        # Weights of a spectrum come to 1 but for their rounding.
        values = (0.1 * chord - np.log(np.full(100, 0.01, np.float32).sum() - 3e-7)).astype(np.float32)
        assert 0 < values.min() < 1e-6
    elif kind == "noise of matter alone":
        values = (0.1 * chord * np.random.default_rng(1).normal(1, 0.02, chord.shape)).astype(np.float32)
    elif kind == "one ray":
        values[0, 0, 0] = -1.0
    before = values.copy()
    assert lower_end(values) is None and mend_light_end(values) == 0
    assert not caplog.records
    np.testing.assert_array_equal(values, before)
