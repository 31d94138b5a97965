"""Refuse projections that are not -log(I/I0): counts, transmissions, logarithms of the wrong sign or scale.

:mod:`tomo_polysplat.scan.probes.logarithm` asks the same of a file and only warns. This module refuses a scan, so it
must be certain. For example, a view from inside a hollow object also has less in its middle than at its ends.
"""

from __future__ import annotations

import logging

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.scan.probes.logarithm import COUNTS, REMEDIES, SIGN, TRANSMISSIONS

__all__ = ["require_line_integrals"]

logger = logging.getLogger(__name__)

# Views and rows to look at; with fewer columns than the last number the ends do not show air.
_VIEWS, _ROWS, _FEWEST_COLUMNS = 48, 16, 8
# Share of the columns at each end that counts as air; air is flat, and the same at both ends, to the second number.
_BORDER, _FLAT = 0.04, 0.05
# In transmissions air is this close to 1, and an object takes away at least the second share of the light.
_NEAR_ONE, _TAKEN = 0.05, 0.4
# In counts air is brighter than the first number. A value beyond the other two marks a bad ray.
_DIMMEST, _BRIGHTEST = 30.0, 1e9
_BRIGHTEST_LOGARITHM = -745.0
# A ray through matter has more than the first value; at most half of these have more than the second, e^-100 of the
# light. Large values are counts and not marks of bad rays if there are more different ones than the third number.
_SOMETHING, _OPAQUE, _DIFFERENT = 0.3, 100.0, 16
# Warn if there is this much more light behind the object than beside it.
_LITTLE = 0.1
# Light is e^(first number) times that without an object, in more than the second share of the rays, and fewer than the
# third share of them are as much darker: neither noise nor a flaw of the flat field does that.
_SURE, _MANY, _FEW = 1.0, 0.02, 0.1


def require_line_integrals(values: np.ndarray, marked: np.ndarray | None = None) -> None:
    """Refuse what is certainly not -log(I/I0), and warn of what hardly is.

    Parameters
    ----------
    values : (views, rows, columns) float32 array
        Single values may be infinite, NaN or senseless.
    marked : bool array of that shape, optional
        True for rays that are not to be used.

    Raises
    ------
    ValueError
        For counts, transmissions, logarithms of the other sign or of a wrong scale, with what to pass instead.
    """
    chosen = np.ix_(*(evenly_spread(n, most) for n, most in zip(values.shape, (_VIEWS, _ROWS))))
    some = values[chosen]
    meant = (some > _BRIGHTEST_LOGARITHM) & (some < _BRIGHTEST)
    some = np.where(meant if marked is None else meant & ~marked[chosen], some, np.nan)
    if len(np.unique(some[some > _DIMMEST])) <= _DIFFERENT:
        some[some > _DIMMEST] = np.nan
    finite = some[np.isfinite(some)]
    if not finite.size:
        return
    _require_some_light(finite)
    low, high = (float(value) for value in np.percentile(finite, [1, 99]))
    air = _air(some, high - low)
    if air is None:
        return
    below, above = air - low, high - air
    if below <= 2 * above or below < (_SOMETHING if air > _SOMETHING else _LITTLE):
        return
    kind, certain = _kind(finite, air, low)
    seen = f"{air:.3g} beside the object and down to {low:.3g} behind it"
    if certain:
        raise fail("projections", "-log(I/I0), to which an object adds", f"{kind}: {seen}", REMEDIES[kind])
    logger.warning(
        "The projections do not look like -log(I/I0): %s. If they are %s, %s.", seen, kind, REMEDIES[kind]
    )


def _require_some_light(finite: np.ndarray) -> None:
    """Refuse a scan where no light passes most of the object: counts, or logarithms times a large number."""
    dark = finite[finite > _OPAQUE]
    # Noise in air is as often negative as positive, so the negative values tell how many positive ones are noise.
    dim = np.count_nonzero((finite > _SOMETHING) & (finite <= _OPAQUE)) - np.count_nonzero(
        finite < -_SOMETHING
    )
    if len(dark) <= max(dim, _DIFFERENT):
        return
    got = f"values around {np.median(dark):.3g}, as of {COUNTS} or of a wrong scale"
    remedy = f"{REMEDIES[COUNTS]}; undo a factor that they were multiplied by"
    raise fail("projections", "-log(I/I0), some 10 at most, not intensities", got, remedy)


def _air(some: np.ndarray, span: float) -> float | None:
    """The value of air, at both ends of the columns; None unless it is flat and the same there, against `span`."""
    (known,) = (np.isfinite(some).mean(axis=(0, 1)) > 0.5).nonzero()
    if len(known) < _FEWEST_COLUMNS:
        return None
    width = max(2, int(_BORDER * len(known)))
    columns = np.concatenate([known[:width], known[-width:]])
    ends = np.nanmedian(some[..., columns], axis=(0, 1)).astype(np.float64)
    air = float(np.median(ends))
    return air if float(np.ptp(ends)) <= _FLAT * max(span, abs(air)) else None


def _kind(finite: np.ndarray, air: float, low: float) -> tuple[str, bool]:
    """What the values look like, and whether that is certain."""
    if air > _DIMMEST:
        return COUNTS, True
    if air > _SOMETHING:
        return TRANSMISSIONS, abs(air - 1) < _NEAR_ONE and -_NEAR_ONE < low < 1 - _TAKEN
    brighter, darker = float((finite < -_SURE).mean()), float((finite > _SURE).mean())
    return SIGN, brighter > _MANY and darker < _FEW * brighter
