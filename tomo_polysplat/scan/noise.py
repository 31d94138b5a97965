"""How noisy the rays are, read off the data."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

__all__ = ["photons_per_ray"]

_VIEWS = 24
# This many rays tell the noise to half a per cent.
_MOST = 8_000_000
_BINS = 16
_LARGEST_EXPONENT = 700.0
# Error of a variance told by the median absolute deviation of n normal values, times sqrt(n), and how many of it tell.
_OF_A_MEDIAN, _CLEARLY = 2.33, 3.0


def photons_per_ray(
    projections: np.ndarray | torch.Tensor,
    dimmed: np.ndarray | torch.Tensor | None = None,
    device: torch.device | None = None,
    given: Sequence[float] = (),
) -> float:
    """Photons of an unattenuated ray, from the scatter of neighbouring pixels.

    Counts that are Poisson distributed give ``-log(I/I0)`` a variance ``exp(P) / I0``. The variance is taken
    from second differences along detector rows, ``p[j-1] - 2 p[j] + p[j+1]``, whose variance is six times
    that of a pixel. It is estimated by the median absolute deviation, which edges disturb little. Structure can only
    add to the variance, so the quietest bins of P give the noise. So do gains of pixels, which all views have in
    common: where each pixel's mean over the views is clearly a part of the variance, it is left out.

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
    float
        ``I0``, at least 1; infinity for data without noise.
    """
    if projections.shape[2] < 5:
        return float("inf")
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
    (plain, error), (own, _) = (
        _variance((kept * whole).abs(), middle) for kept in (difference, _of_views(difference))
    )
    variance = own if own < (1 - _CLEARLY * error) * plain else plain
    return max(1.0, 1 / variance) if 0 < variance < math.inf else float("inf")


def _variance(difference: torch.Tensor, middle: torch.Tensor) -> tuple[float, float]:
    """Of an unattenuated ray, from second differences and the values that they lie among, and its relative error.

    Infinity if they are too few.
    """
    good = torch.isfinite(difference) & torch.isfinite(middle)
    difference, middle = difference[good], middle[good]
    if len(middle) < 4 * _BINS:
        return float("inf"), 1.0
    middle, order = middle.sort()
    rates = []
    for values, differences in zip(middle.tensor_split(_BINS), difference[order].tensor_split(_BINS)):
        deviation = 1.4826 * _median(differences.sort().values) / math.sqrt(6)
        # A broken detector may give values whose exponential no float can hold.
        level = min(max(_median(values), -_LARGEST_EXPONENT), _LARGEST_EXPONENT)
        rates.append(deviation**2 / math.exp(level))
    return sorted(rates)[_BINS // 8], _OF_A_MEDIAN / math.sqrt(len(middle) / _BINS)


def _of_views(values: torch.Tensor) -> torch.Tensor:
    """(views, rows, columns) less each pixel's mean over the views, of the same noise; NaN where there is one view."""
    good = torch.isfinite(values)
    count = good.sum(dim=0, dtype=values.dtype)
    mean = torch.where(good, values, torch.zeros_like(values)).sum(dim=0) / count
    # As many as the mean takes of the variance are missing (Bessel).
    return (values - mean) * torch.sqrt(count / (count - 1))


def _median(ordered: torch.Tensor) -> float:
    return float(0.5 * (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]))
