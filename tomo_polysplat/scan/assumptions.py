"""Which of several assumptions the rays prefer, and by how many standard errors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

__all__ = ["RULED_OUT", "Comparison", "Located", "compare", "locate"]

# Fewer parts of a scan than these do not tell their own scatter.
_FEWEST_PARTS = 4
# Neighbouring rays go wrong together; so many count as one.
_TOGETHER = 3.0
# Of the largest energy: below it there is nothing but rounding.
_ROUNDING = 1e-10
# An assumption is ruled out that is so many standard errors worse than the best.
RULED_OUT = 4.0
# A place is uncertain whose standard error is larger, in columns.
_LARGEST_ERROR = 1.0
# Where more than this of the variance differs, things are not alike.
_LARGEST_MISMATCH = 0.5


class Comparison(NamedTuple):
    """What the rays say of each assumption.

    Attributes
    ----------
    best : int
        The assumption that the rays prefer.
    mismatch : (assumptions,)
        Squared differences over the variance there is to explain: 0 for a perfect match, 1 for chance; NaN where there
        is nothing to compare.
    doubt : (assumptions,)
        How much worse than the best, in standard errors; infinite where `mismatch` is NaN.
    without : (parts, assumptions)
        `mismatch` without each part of the scan.
    """

    best: int
    mismatch: np.ndarray
    doubt: np.ndarray
    without: np.ndarray


class Located(NamedTuple):
    """A place on the detector.

    Attributes
    ----------
    place : float
        In columns.
    uncertainty : float
        Standard error; infinite where the rays do not tell one place from others.
    mismatch : float
        Share of the variance that is not explained there.
    doubt : str
        Why it is uncertain; empty where it is not.
    """

    place: float
    uncertainty: float
    mismatch: float
    doubt: str


def compare(differences: np.ndarray, variances: np.ndarray, samples: np.ndarray) -> Comparison | None:
    """Compare assumptions by how well rays agree that ought to be equal.

    Parameters
    ----------
    differences, variances : (parts, assumptions)
        Sums, over parts of the scan with noise of their own, of the squared differences and of the squares about the
        means of what is compared.
    samples : (assumptions,)
        Pairs of rays compared.

    Returns
    -------
    Comparison or None
        None where no assumption has anything to compare.

    Notes
    -----
    The logarithms of mismatches are compared. The standard error of a difference of two is that of the jackknife over
    the parts (Efron 1982), and not less than that of independent squares: the logarithm of a mean of n squares scatters
    by ``sqrt(2 / n)``.
    """
    total = variances.sum(axis=0)
    something = total > _ROUNDING * max(float(total.max()), 1e-300)
    if not something.any():
        return None
    mismatch = _ratio(differences.sum(axis=0), total, something)
    best = int(np.nanargmin(mismatch))
    error = 2 * _TOGETHER * (1 / np.maximum(samples, 1) + 1 / max(samples[best], 1))
    without = np.zeros((0, len(samples)))
    if len(differences) >= _FEWEST_PARTS:
        rest = total - variances
        without = _ratio(differences.sum(axis=0) - differences, rest, something & (rest > _ROUNDING * total))
        change = np.log(without / without[:, best : best + 1])
        scatter = np.var(np.where(np.isfinite(change), change, 0), axis=0)
        error = np.maximum(error, scatter * (len(differences) - 1))
    worse = np.where(something, np.log(np.where(something, mismatch, 1) / mismatch[best]), np.inf)
    return Comparison(best, mismatch, worse / np.sqrt(error), without)


def _ratio(above: np.ndarray, below: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Quotient where there is one; a perfect match is as good as rounding lets it be."""
    return np.where(where, np.maximum(above / np.where(where, below, 1), _ROUNDING), np.nan)


def locate(found: Comparison, places: np.ndarray) -> Located:
    """The best of evenly spaced `places` (assumptions,), refined by a parabola, with its uncertainty."""
    best, step = found.best, float(places[1] - places[0])
    place = float(places[best] + step * _parabola_offset(found.mismatch, best))
    beside = [found.doubt[k] for k in (best - 1, best + 1) if 0 <= k < len(places)]
    error = step / np.sqrt(1 + max(min(beside), 0.0))
    if len(found.without):
        each = step * np.array([_parabola_offset(line, best) for line in found.without])
        error = float(each.std() * np.sqrt(len(each) - 1))
    possible = places[found.doubt < RULED_OUT]
    # What is not ruled out is so many standard errors away at most; between neighbours the parabola tells.
    error = max(error, (float(np.abs(possible - places[best]).max()) - step) / RULED_OUT)
    doubt = ""
    if found.mismatch[best] > _LARGEST_MISMATCH:
        doubt = "rays that should agree do not, wherever the axis is"
    elif error > _LARGEST_ERROR:
        doubt = f"anything from column {possible.min():.1f} to {possible.max():.1f} explains the rays as well"
    return Located(place, np.inf if doubt else error, float(found.mismatch[best]), doubt)


def _parabola_offset(scores: np.ndarray, best: int) -> float:
    """Position of the minimum of the parabola through three scores, relative to the middle one."""
    if not 0 < best < len(scores) - 1:
        return 0.0
    left, middle, right = scores[best - 1 : best + 2]
    curvature = left - 2 * middle + right
    return float(0.5 * (left - right) / curvature) if curvature > 0 else 0.0
