"""Filters of filtered backprojection: known taps, and rows that end where the detector does."""

import numpy as np
import pytest

from tomo_polysplat.start.filters import FILTERS, filter_rows, ramp_response


def test_the_ramp_has_no_offset_and_known_taps():
    for length in (64, 97):
        response = ramp_response(length)
        taps = np.fft.irfft(response, length)
        assert taps[0] == pytest.approx(0.25)
        assert taps[1] == pytest.approx(-1 / np.pi**2)
        assert taps[2] == pytest.approx(0, abs=1e-15)
        # |f|, except at both ends, where the finite length shows.
        np.testing.assert_allclose(response[4:-1], np.fft.rfftfreq(length)[4:-1], atol=2e-3)
    smooth = {name: ramp_response(64, name)[-1] for name in FILTERS}
    assert sorted(smooth, key=smooth.get) == ["hann", "cosine", "hamming", "shepp-logan", "ram-lak"]


def test_filtering_continues_beyond_the_detector():
    rows = np.random.default_rng(0).random((2, 3, 31)).astype(np.float32)
    wide = filter_rows(rows, "hann", 7, 5)
    assert wide.shape == (2, 3, 43)
    padded = np.pad(rows, ((0, 0), (0, 0), (7, 5)))
    np.testing.assert_allclose(wide, filter_rows(padded, "hann"), atol=2e-3)
    np.testing.assert_allclose(wide[..., 7:-5], filter_rows(rows, "hann"), atol=2e-3)
