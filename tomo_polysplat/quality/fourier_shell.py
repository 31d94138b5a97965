"""Fourier shell correlation: at which fineness two volumes still agree."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.checks import require_array, require_shape
from tomo_polysplat.result.detail import ShellCorrelation

__all__ = ["HALVES", "TRUTH", "first_below", "shell_correlation"]

# Where a volume of all views correlates by 1/2 with the truth, halves of them correlate by 1/7 if their errors are
# independent: the correlation with the truth is sqrt(2 c / (1 + c)), and 1/2 at c = 1/7 (Rosenthal and Henderson 2003,
# doi:10.1016/j.jmb.2003.07.013).
HALVES, TRUTH = 1 / 7, 0.5
# A shell of fewer coefficients says little; shells are averaged with those beside them, weighed by their numbers.
_FEWEST = 12


def shell_correlation(
    one: np.ndarray, other: np.ndarray, voxel_size: np.ndarray, weight: np.ndarray | None = None
) -> ShellCorrelation:
    """Correlation of two volumes, shell by shell of their Fourier transforms (Harauz and van Heel 1986).

    Parameters
    ----------
    one, other : (z, y, x) arrays
        An axis of length one is left out, and shells are rings.
    voxel_size : (3,)
        Edges (x, y, z).
    weight : (z, y, x) array, optional
        What counts, 0 to 1; its edges have to be soft, for both volumes share them. The weighted mean is taken off.
    """
    one, other = (require_array("volume", volume, 3) for volume in (one, other))
    require_shape("volumes", other, one.shape, "alike")
    several = [n > 1 for n in one.shape]
    edges = np.asarray(voxel_size, float)[::-1][several]
    shape = tuple(n for n in one.shape if n > 1)
    mask = np.ones(shape, np.float32) if weight is None else weight.reshape(shape)
    parts = [_transform(volume.reshape(shape), mask) for volume in (one, other)]
    step = 1 / float((np.array(shape) * edges).min())
    shells = round(0.5 / float(edges.max()) / step)
    index = np.minimum(np.rint(_frequencies(shape, edges) / step).astype(np.int64), shells + 1).ravel()
    twice = _twice(parts[0].shape, shape[-1])

    def sums(values: np.ndarray) -> np.ndarray:
        counted = np.bincount(index, (values * twice).ravel(), minlength=shells + 2)
        return np.convolve(np.pad(counted[1 : shells + 1], 1, mode="edge"), np.ones(3), mode="valid")

    cross = sums((parts[0] * parts[1].conj()).real)
    powers = [sums(np.abs(part) ** 2) for part in parts]
    number = sums(np.ones(parts[0].shape))
    both = np.sqrt(powers[0] * powers[1])
    good = (both > 1e-12 * max(both.max(initial=0.0), 1e-300)) & (number >= _FEWEST)
    correlation = np.divide(cross, both, out=np.full(shells, np.nan), where=good)
    return ShellCorrelation(step * np.arange(1, shells + 1), correlation)


def first_below(found: ShellCorrelation, level: float) -> float | None:
    """Frequency at which the correlation falls below a level first; None where it never does."""
    known = np.isfinite(found.correlation)
    frequency, correlation = found.frequency[known], found.correlation[known]
    below = np.flatnonzero(correlation < level)
    if not len(below):
        return None
    k = int(below[0])
    if k == 0:
        return float(frequency[0])
    fall = correlation[k - 1] - correlation[k]
    return float(frequency[k - 1] + (frequency[k] - frequency[k - 1]) * (correlation[k - 1] - level) / fall)


def _transform(volume: np.ndarray, weight: np.ndarray) -> np.ndarray:
    from scipy import fft

    mean = float((volume * weight).sum(dtype=np.float64) / max(float(weight.sum(dtype=np.float64)), 1e-12))
    return fft.rfftn(np.asarray((volume - mean) * weight, np.float32))


def _frequencies(shape: tuple[int, ...], edges: np.ndarray) -> np.ndarray:
    """Of each coefficient of `_transform`, in cycles per unit of length."""
    axes = [np.fft.fftfreq(n, edge) for n, edge in zip(shape[:-1], edges)]
    axes.append(np.fft.rfftfreq(shape[-1], edges[-1]))
    return np.sqrt(sum(part**2 for part in np.meshgrid(*axes, indexing="ij", sparse=True)))


def _twice(shape: tuple[int, ...], length: int) -> np.ndarray:
    """For how many coefficients each one stands: the last axis, of so many voxels, is halved."""
    twice = np.full(shape, 2.0)
    twice[..., 0] = 1.0
    if length % 2 == 0:
        twice[..., -1] = 1.0
    return twice
