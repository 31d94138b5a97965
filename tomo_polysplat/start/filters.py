"""Ramp filtering of projections."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.checks import require_choice

__all__ = ["FILTERS", "filter_rows", "ramp_response"]

FILTERS = ("ram-lak", "shepp-logan", "cosine", "hamming", "hann")


def ramp_response(length: int, filter_name: str = "ram-lak") -> np.ndarray:
    """Response of the band-limited ramp at the ``length // 2 + 1`` frequencies of a real FFT.

    The ramp is sampled in space, ``h[0] = 1/4``, ``h[odd n] = -1 / (pi n)^2`` for pixels of size 1, and
    transformed: sampled in frequency it would miss the mean of the projection and shift every value
    (Kak and Slaney, Principles of Computerized Tomographic Imaging, 1988, chapter 3).
    """
    require_choice("filter_name", filter_name, FILTERS)
    distance = np.minimum(np.arange(length), length - np.arange(length))
    kernel = np.zeros(length)
    odd = distance % 2 == 1
    kernel[odd] = -1.0 / (np.pi * distance[odd]) ** 2
    kernel[0] = 0.25
    frequency = np.fft.rfftfreq(length) * 2.0  # 1 at Nyquist
    window = {
        "ram-lak": np.ones_like(frequency),
        "shepp-logan": np.sinc(0.5 * frequency),
        "cosine": np.cos(0.5 * np.pi * frequency),
        "hamming": 0.54 + 0.46 * np.cos(np.pi * frequency),
        "hann": 0.5 + 0.5 * np.cos(np.pi * frequency),
    }[filter_name]
    return np.fft.rfft(kernel).real * window


def filter_rows(rows: np.ndarray, filter_name: str, before: int = 0, after: int = 0) -> np.ndarray:
    """Ramp-filter along the last axis, taking what lies outside as zero.

    Parameters
    ----------
    rows : (..., columns) float32
        Projections.
    filter_name : str
        One of `FILTERS`.
    before, after : int
        Columns to return beyond either end: a filtered projection does not end where the projection does.

    Returns
    -------
    (..., before + columns + after) float32
    """
    from scipy.fft import irfft, next_fast_len, rfft

    columns = rows.shape[-1]
    length = next_fast_len(2 * (columns + max(before, after)), real=True)
    response = ramp_response(length, filter_name).astype(np.float32)
    filtered = irfft(rfft(rows, length, axis=-1) * response, length, axis=-1)
    wanted = [filtered[..., length - before :], filtered[..., : columns + after]]
    return np.concatenate(wanted, axis=-1) if before else np.ascontiguousarray(wanted[1])
