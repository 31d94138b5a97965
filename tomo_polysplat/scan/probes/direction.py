"""Which way round a fan or a cone went: the way in which opposite rays agree better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tomo_polysplat.scan.assumptions import RULED_OUT, compare
from tomo_polysplat.scan.axis_offset import LARGEST_SHARE, AxisOffset, offset_of, spread
from tomo_polysplat.scan.opposite_rays import OppositeRays

__all__ = ["MUCH_BETTER", "REMEDY", "direction_doubt", "runs_backwards", "turned_round"]

# Views that are compared, and those that it takes to tell; pairs of any place that a place must have, of the most.
_VIEWS, _FEWEST_VIEWS, _ENOUGH = 60, 24, 0.2
# Where both ways leave less than this share of the variance, the object looks the same turned round: 80 scans that did
# go the other way left 0.010 and more as told, and pins, on a circle, 0.0008 at most.
_ALIKE = 0.003
# The other direction must fit this many times better.
MUCH_BETTER = 2.0
# Rays do not tell a wrong direction from mirrored pictures: either makes the other's volume a mirror image.
REMEDY = "take the angles times -1 (or reverse the views); where pictures are mirrored, mirror their columns instead"


def turned_round(rays: OppositeRays) -> OppositeRays:
    """The same rays if the angles ran the other way."""
    return replace(rays, slope=-rays.slope)


def runs_backwards(rays: OppositeRays, told: AxisOffset) -> float:
    """How many times better opposite rays agree with the angles turned round, where that is beyond doubt; 0 if not.

    Parameters
    ----------
    rays : OppositeRays
        Of a fan or a cone.
    told : AxisOffset
        Where the axis is as told.
    """
    turned = offset_of(turned_round(rays))
    doubt, ratio = direction_doubt(rays, told, turned)
    sure = doubt < -RULED_OUT and ratio > MUCH_BETTER and not turned.doubt
    return ratio if sure else 0.0


def direction_doubt(rays: OppositeRays, told: AxisOffset, turned: AxisOffset) -> tuple[float, float]:
    """How much better opposite rays agree as told than turned round.

    Parameters
    ----------
    rays : OppositeRays
        Of a fan or a cone.
    told, turned : AxisOffset
        Where the axis is either way; where that is not known, it is where rays agree best.

    Returns
    -------
    doubt : float
        By how many standard errors they agree better as told; 0 where nothing tells.
    ratio : float
        The mismatch as told by that turned round.
    """
    if len(rays.azimuth) < _FEWEST_VIEWS:
        return 0.0, 1.0
    both = [_sums(*one) for one in ((rays, told), (turned_round(rays), turned))]
    differences, variances, samples = (np.stack(one, axis=-1) for one in zip(*both))
    found = compare(differences, variances, samples)
    if found is None or not np.isfinite(found.doubt).all() or found.mismatch.max() < _ALIKE:
        return 0.0, 1.0
    return float(found.doubt[1] - found.doubt[0]), float(found.mismatch[0] / found.mismatch[1])


def _sums(rays: OppositeRays, axis: AxisOffset) -> tuple[np.ndarray, np.ndarray, int]:
    """Squared differences of opposite rays and squares about the mean, by view, and pairs, at the axis."""
    lines, columns = spread(rays, _VIEWS)
    places = [-axis.columns] if not axis.doubt else _places(rays.values.shape[1])
    compared = [rays.pairs(float(place), lines, columns) for place in places]
    many = np.array([np.count_nonzero(pairs.weight) for pairs in compared])
    mismatch = np.array([pairs.mismatch for pairs in compared])
    best = int(np.argmin(np.where(many >= _ENOUGH * many.max(), mismatch, np.inf)))
    weight, sides = compared[best].weight, (compared[best].own, compared[best].opposite)
    total = max(float(weight.sum()), 1e-300)
    squares = sum((weight * (side - (weight * side).sum() / total) ** 2).sum(axis=(1, 2)) for side in sides)
    return (weight * (sides[0] - sides[1]) ** 2).sum(axis=(1, 2)), squares, int(many[best])


def _places(columns: int) -> np.ndarray:
    """All that are searched, half a column apart."""
    reach = np.ceil(LARGEST_SHARE * columns)
    return np.arange(-reach, reach + 0.25, 0.5)
