"""What detector and source did, out of what a fit leaves of the rays: shrunk by how well it is known.

Nothing here is a threshold. The variance that exceeds what is known to be noise says how much of a mean is believed
(empirical Bayes: Morris 1983, doi:10.1080/01621459.1983.10477920), and what neighbours have in common is the
object's or the spectrum's.
"""

from __future__ import annotations

import math

import numpy as np

__all__ = ["drift_of_views", "gains_of_pixels"]

# Blocks of pixels over which a variance is averaged: one pixel's is rough.
_AROUND = 7
# Deviation, in waves per detector, over which the power of waves is averaged.
_WAVES = 3.0
# What lies beyond so many deviations of the most is one pixel's fault and does not count for all.
_FAR = 4.0
# The median of an exponential distribution in its means; a normal deviation in median absolute ones.
_MEDIAN, _NORMAL = math.log(2), 1.4826
_ROUNDS, _FEWEST_VIEWS = 8, 5


def gains_of_pixels(weight: np.ndarray, total: np.ndarray, axis: float = math.nan) -> np.ndarray:
    """Log-gain of each pixel, (rows, columns), less what the object is likely to have.

    Gains are taken for white: as strong for all waves across the detector. What is stronger for some is not theirs, and
    is left by Wiener's filter. Pixels as far from the axis of rotation, on both sides, see the same ring of the object:
    what differs between them is not the object's, and tells how strong gains are.

    Parameters
    ----------
    weight : (blocks, rows, columns) array
        Sums over the rays of each pixel, by blocks of views that lie apart, of inverse variances up to a factor.
    total : (blocks, rows, columns) array
        Likewise of these times measurement less model.
    axis : float
        Column of the axis of rotation; NaN, or far beyond the detector, where there are no rings.
    """
    mean, noise = _means(weight, total)
    good = np.isfinite(noise)
    if not good.any():
        return np.zeros(mean.shape)
    value, noise = np.where(good, mean - np.median(mean[good]), 0.0), np.where(good, 0.5 * noise, 0.0)
    others, paired = _opposite(good, axis)
    # Of a pair both parts have half of the variance; a pixel without another one is brought to that.
    size = np.where(paired, 1.0, math.sqrt(0.5))
    common, apart = 0.5 * size * (value + value[:, others]), 0.5 * (value - value[:, others])
    common[~paired & good] = (size * value)[~paired & good]
    apart[~paired] = 0.0
    telling, where = (apart, paired) if paired.any() else (common, good)
    floor = _floor(_power(_near(telling, where)) / where.mean())
    return np.where(
        good, _white(common, noise, good, floor) / size + _white(apart, noise, paired, floor), 0.0
    )


def _opposite(good: np.ndarray, axis: float) -> tuple[np.ndarray, np.ndarray]:
    """Column on the other side of the axis, itself where there is none, and which pixels have a good one there."""
    columns = np.arange(good.shape[1])
    if not math.isfinite(axis):
        return columns, np.zeros_like(good)
    others = np.rint(2 * axis - columns).astype(int)
    there = (others >= 0) & (others < len(columns)) & (others != columns)
    others = np.where(there, others, columns)
    return others, good & good[:, others] & there


def _white(part: np.ndarray, noise: np.ndarray, there: np.ndarray, floor: float) -> np.ndarray:
    """Of what pixels have, as much as is white, with this power, and no noise."""
    excess = max(0.0, floor - float(noise[there].mean())) if there.any() else 0.0
    if not excess > 0.0:
        return np.zeros(part.shape)
    believed = np.where(there, part * excess / (excess + noise), 0.0)
    power = _averaged(_power(_near(part, there)) / there.mean())
    waves = np.fft.fft2(believed) * np.minimum(1.0, floor / np.maximum(power, floor))
    waves[0, 0] = 0.0
    return np.fft.ifft2(waves).real


def _near(values: np.ndarray, there: np.ndarray) -> np.ndarray:
    """The values, those of a few pixels that are far off brought nearer."""
    usual = _FAR * _NORMAL * float(np.median(np.abs(values[there])))
    return np.clip(values, -usual, usual)


def _means(weight: np.ndarray, total: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean of each pixel, and its squared standard error by how much blocks differ; NaN where no ray tells."""
    whole = weight.sum(axis=0)
    used = (weight > 0).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = total.sum(axis=0) / whole
        apart = np.where(weight > 0, weight * (total / weight - mean) ** 2, 0.0).sum(axis=0)
        noise = apart / whole / (used - 1)
    good = used > 1
    return np.where(good, mean, np.nan), np.where(good, _around(np.where(good, noise, 0.0), good), np.nan)


def _around(values: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Mean of those around each that are good."""
    from scipy.ndimage import uniform_filter

    share = uniform_filter(good.astype(float), _AROUND, mode="nearest")
    return uniform_filter(values, _AROUND, mode="nearest") / np.maximum(share, 1e-9)


def _power(value: np.ndarray) -> np.ndarray:
    """Power of each wave, such that the mean over all is the mean square of the pixels."""
    return np.abs(np.fft.fft2(value)) ** 2 / value.size


def _floor(power: np.ndarray) -> float:
    """Power of the short waves, whatever a few of them have."""
    rows, columns = (np.abs(np.fft.fftfreq(n)) for n in power.shape)
    short = np.maximum(rows[:, None], columns[None]) > 0.25
    return float(np.median(power[short])) / _MEDIAN if short.any() else 0.0


def _averaged(power: np.ndarray) -> np.ndarray:
    """Power of waves averaged over those that are about as long in the same direction."""
    from scipy.ndimage import gaussian_filter

    power = power.copy()
    power[0, 0] = 0.0
    deviations = [_WAVES if n > 1 else 0.0 for n in power.shape]
    return gaussian_filter(power, deviations, mode="wrap")


def drift_of_views(count: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Log-factor of the light of each view, (views,), without mean.

    Rays of like depth go together: those beside the object, which hardly any model misses, differ between views by
    little else than the source, and count most. By how much a depth is wrong is told by the two halves of the
    detector, which see the same source; what both have in common is believed.

    Parameters
    ----------
    count, total : (2, views, depths) array
        Number of rays and sum of measurement less model, of the left half of the detector and of the right one.
    """
    there = (count[0] > 0) & (count[1] > 0)
    depths = there.mean(axis=0) > 0.5
    count, total, there = count[..., depths], total[..., depths], there[:, depths]
    halves = np.where(there, total / np.maximum(count, 1), 0.0)
    views = len(there)
    if not depths.any() or views < _FEWEST_VIEWS:
        return np.zeros(views)
    apart = [_without_means(half, there) for half in halves]
    own = ((apart[0] - apart[1]) ** 2).sum(axis=0) / there.sum(axis=0)
    trust = np.where(there, 1 / np.maximum(own, 1e-16), 0.0)
    left, right = (_drift_of_half(half, trust, there) for half in halves)
    drift, noise = 0.5 * (left + right), 0.25 * float((left - right).var())
    excess = max(0.0, float(drift.var()) - noise)
    return drift * excess / (excess + noise) if excess > 0 else np.zeros(views)


def _drift_of_half(mean: np.ndarray, trust: np.ndarray, there: np.ndarray) -> np.ndarray:
    """(views,) weighted mean of (views, depths), each depth less its own mean over the views."""
    drift = np.zeros(len(mean))
    for _ in range(_ROUNDS):
        apart = _without_means(mean - drift[:, None], there) + drift[:, None] * there
        drift = (trust * apart).sum(axis=1) / np.maximum(trust.sum(axis=1), 1e-300)
        drift -= drift.mean()
    return drift


def _without_means(values: np.ndarray, there: np.ndarray) -> np.ndarray:
    """(views, depths) less the mean of each depth over the views; 0 where there is none."""
    means = np.where(there, values, 0.0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
    return np.where(there, values - means, 0.0)
