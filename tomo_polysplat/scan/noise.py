"""How noisy the rays are, read off the data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np
import torch

from tomo_polysplat.evenly_spread import evenly_spread

__all__ = ["RayNoise", "Values", "correlation_of_noise", "photons_per_ray", "ray_noise"]

Values = TypeVar("Values", np.ndarray, torch.Tensor)

_VIEWS = 24
# This many rays tell the noise to half a per cent.
_MOST = 8_000_000
_BINS = 16
_LARGEST_EXPONENT = 700.0
# Error of a variance told by the median absolute deviation of n normal values, times sqrt(n), and how many of it tell.
_OF_A_MEDIAN, _CLEARLY = 2.33, 3.0

# Rays beside the object have no larger -log(I/I0), by those beside them; so many of them tell how noise correlates.
_AIR, _FEWEST_IN_AIR = 0.05, 500


class RayNoise(NamedTuple):
    """Noise of ``-log(I/I0)``: that of counts, which grows with depth, or one that is as strong in every ray.

    Attributes
    ----------
    photons : float
        Of an unattenuated ray; infinity where it is not that of counts, or where there is none.
    deviation : float
        Of every ray, where it is as strong in all; else 0.
    """

    photons: float = math.inf
    deviation: float = 0.0

    @property
    def shows(self) -> bool:
        """Whether there is any."""
        return math.isfinite(self.photons) or self.deviation > 0

    def variance(self, depth: Values) -> Values:
        """Of rays with this ``-log(I/I0)``: ``exp(P) / I0`` for Poisson distributed counts."""
        grows = torch.exp(depth) if isinstance(depth, torch.Tensor) else np.exp(depth)
        return grows / self.photons + self.deviation**2


def photons_per_ray(
    projections: np.ndarray | torch.Tensor,
    dimmed: np.ndarray | torch.Tensor | None = None,
    device: torch.device | None = None,
    given: Sequence[float] = (),
) -> float:
    """Photons of an unattenuated ray, at least 1; infinity for data without the noise of counts. See `ray_noise`."""
    return ray_noise(projections, dimmed, device, given).photons


def ray_noise(
    projections: np.ndarray | torch.Tensor,
    dimmed: np.ndarray | torch.Tensor | None = None,
    device: torch.device | None = None,
    given: Sequence[float] = (),
) -> RayNoise:
    """How noisy the rays are, from the scatter of neighbouring pixels.

    Counts that are Poisson distributed give ``-log(I/I0)`` a variance ``exp(P) / I0``. The variance is taken
    from second differences along detector rows, ``p[j-1] - 2 p[j] + p[j+1]``, whose variance is six times
    that of a pixel. It is estimated by the median absolute deviation, which edges disturb little. Structure can only
    add to the variance, so the quietest bins of P give the noise. So do gains of pixels, which all views have in
    common: where each pixel's mean over the views is clearly a part of the variance, it is left out.

    Line integrals that were simulated with normal noise, or smoothed according to their depth, have a variance that
    does not grow with P. It is likewise that of the quietest bins. Of the two, the one that lies clearly closer beneath
    the variances of all bins is the noise.

    Parameters
    ----------
    projections : (views, rows, columns) array or tensor
        -log(I/I0); NaN where a ray is unusable.
    dimmed : (rows, columns) array or tensor, optional
        -log of the share of the beam that reaches each pixel through a filter of its own.
    device : torch.device, optional
        Where to compute it; where the projections are by default.
    given : sequence of float
        Values that opaque and saturated rays were given: these have no noise.

    Returns
    -------
    RayNoise
        Of at least one photon.
    """
    if projections.shape[2] < 5:
        return RayNoise()
    some = projections[:: max(1, len(projections) // _VIEWS)]
    rows = max(1, -(-math.prod(some.shape) // _MOST))
    some = some[:, ::rows]
    some = torch.from_numpy(np.array(some)) if isinstance(some, np.ndarray) else some
    some = some.to(device).double()
    for value in given:
        some = torch.where(some == value, torch.nan, some)
    difference = some[..., 3:-1] - 2 * some[..., 2:-2] + some[..., 1:-3]
    # Bins go by the pixels beside the three: if they went by a pixel's own value, its noise would be sorted away.
    middle = 0.5 * (some[..., 4:] + some[..., :-4])
    # As if the pixels had the whole beam: what bins go by is the object alone.
    whole = torch.ones_like(difference[0])
    if dimmed is not None:
        whole = torch.exp(-0.5 * torch.as_tensor(dimmed)[::rows, 2:-2].to(difference))
    plain, own = (_scatter((kept * whole).abs(), middle) for kept in (difference, _of_views(difference)))
    if plain is None:
        return RayNoise()
    found = plain
    # Of a single view less its mean nothing is left.
    if own is not None and own.of_counts < (1 - _CLEARLY * plain.error) * plain.of_counts:
        found = own
    if not 0 < found.of_counts < math.inf:
        return RayNoise()
    # By how much closer one of the two lies beneath all bins, in the mean of the logarithms.
    if dimmed is None and found.closer_alike() > _CLEARLY * found.error:
        return RayNoise(deviation=math.sqrt(found.alike))
    return RayNoise(max(1.0, 1 / found.of_counts))


def correlation_of_noise(projections: torch.Tensor) -> float:
    """How the noise of neighbouring pixels of a row correlates, by rays beside the object; 0 where these are too few.

    It is 0 where each pixel counts photons of its own, and ``exp(-1 / (4 s**2))`` where a scintillator spreads the
    light of each by a Gaussian of deviation s pixels.

    Parameters
    ----------
    projections : (views, rows, columns) tensor
        -log(I/I0); NaN where a ray is unusable.
    """
    views, columns = len(projections), projections.shape[2]
    if views < 2 or columns < 5:
        return 0.0
    before = torch.from_numpy(evenly_spread(views - 1, min(_VIEWS, views - 1))).to(projections.device)
    first, second = (projections[before + k].double() for k in (0, 1))
    # What does not change from view to view, as gains of pixels do not, is no noise.
    change, depth = second - first, 0.5 * (first + second)
    beside = (depth[..., :-3] + depth[..., 3:]).abs() < 2 * _AIR
    left, right = change[..., 1:-2], change[..., 2:-1]
    good = beside & torch.isfinite(left) & torch.isfinite(right)
    if int(good.sum()) < _FEWEST_IN_AIR:
        return 0.0
    middle, pair = torch.median(left[good]), (left[good], right[good])
    most = 4 * 1.4826 * torch.median((pair[0] - middle).abs())
    one, other = ((each - middle).clamp(-most, most) for each in pair)
    power = (one.square().mean() * other.square().mean()).sqrt()
    return float((one * other).mean() / power) if power > 0 else 0.0


class _Scatter(NamedTuple):
    """What the variances in bins of P say.

    Attributes
    ----------
    of_counts, alike : float
        Variance of an unattenuated ray by the quietest bins, were it that of counts, and were it the same in every ray.
    level : float
        Mean of P over the bins.
    error : float
        Relative, of a variance.
    """

    of_counts: float
    alike: float
    level: float
    error: float

    def closer_alike(self) -> float:
        """By how much closer ``alike`` lies beneath the variances than ``of_counts``, in the mean logarithm."""
        return math.log(self.alike) - math.log(self.of_counts) - self.level if self.alike > 0 else -math.inf


def _scatter(difference: torch.Tensor, middle: torch.Tensor) -> _Scatter | None:
    """Of second differences and the values that they lie among; None if they are too few."""
    good = torch.isfinite(difference) & torch.isfinite(middle)
    difference, middle = difference[good], middle[good]
    if len(middle) < 4 * _BINS:
        return None
    middle, order = middle.sort()
    levels, variances = [], []
    for values, differences in zip(middle.tensor_split(_BINS), difference[order].tensor_split(_BINS)):
        deviation = 1.4826 * _median(differences.sort().values) / math.sqrt(6)
        # A broken detector may give values whose exponential no float can hold.
        levels.append(min(max(_median(values), -_LARGEST_EXPONENT), _LARGEST_EXPONENT))
        variances.append(deviation**2)
    rates = [variance / math.exp(level) for variance, level in zip(variances, levels)]
    quiet, alike = (sorted(each)[_BINS // 8] for each in (rates, variances))
    error = _OF_A_MEDIAN / math.sqrt(len(middle) / _BINS)
    return _Scatter(quiet, alike, sum(levels) / _BINS, error)


def _of_views(values: torch.Tensor) -> torch.Tensor:
    """(views, rows, columns) less each pixel's mean over the views, of the same noise; NaN where there is one view."""
    good = torch.isfinite(values)
    count = good.sum(dim=0, dtype=values.dtype)
    mean = torch.where(good, values, torch.zeros_like(values)).sum(dim=0) / count
    # As many as the mean takes of the variance are missing (Bessel).
    return (values - mean) * torch.sqrt(count / (count - 1))


def _median(ordered: torch.Tensor) -> float:
    return float(0.5 * (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]))
