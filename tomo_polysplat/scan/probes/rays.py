"""Which rays hold no measurement?"""

from __future__ import annotations

import math
from functools import reduce

import numpy as np

from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.scan.dropouts import dropped_rays
from tomo_polysplat.scan.probes.finding import DEFECT, OK, UNKNOWN, Finding
from tomo_polysplat.scan.probes.measured import Measured
from tomo_polysplat.scan.scale_end import ONE_PHOTON, dark_end
from tomo_polysplat.scan.stuck import stuck_pixels

__all__ = ["DEAD", "RAYS", "bad_rays", "probe_rays"]

# Shares of bad rays, and of bad views of a pixel, from which they are a defect of the detector.
_TOLERATED, _MOSTLY = 0.002, 0.5
# Share of the views in which a pixel must stand out.
_ALMOST_ALL = 0.8
# Deviation of a pixel from all its neighbours, as a share of the scan's large values.
_STANDS_OUT = 0.1
# Rays without light have dark neighbours: these have at least this share of the scan's large values.
_OPAQUE = 0.6
# Share of the scan's large values that a ray through the object has.
_THROUGH = 0.1
# A value is no measurement that comes so many times as often as any other.
_OFTEN = 3


# Columns that an answer names.
_NAMED = 5

RAYS = "bad rays"
MARKED = "marked as bad"
DEAD, ZERO = "of dead pixels", "zero in the middle of the object"
STARVED = "without light behind dense matter"
# How many rays to look at, and the least number of views.
_MOST_RAYS, _FEWEST_VIEWS = 8_000_000, 12


def bad_rays(measured: Measured) -> dict[str, np.ndarray]:
    """Bad rays by kind, each ray under one kind, as masks (rows, some of the views, columns)."""
    views = _some_views(measured)
    valid, projections = measured.valid[:, views], measured.scan.projections[:, views]
    starved = _starved(projections, valid, measured.level) | _dark_end(projections, valid)
    starved |= _one_photon(projections, valid)
    zero = dropped_rays(np.where(valid, projections, np.nan))
    # Few photons make few values, and that of air is one of them.
    zero &= _stands_out_as_value(projections[valid], 0.0)
    pixels = stuck_pixels(np.where(valid, projections, np.nan).transpose(1, 0, 2), measured.axis_column)
    pixels |= _dead_pixels(projections, valid & ~pixels[:, None], measured.level)
    pixels |= (~valid & ~starved).mean(axis=1) > _MOSTLY
    pixels |= measured.apart[0]
    dead = np.broadcast_to(pixels[:, None], valid.shape)
    return {
        DEAD: dead,
        ZERO: zero & ~dead,
        MARKED: ~valid & ~starved & ~dead,
        "at the limit of the scale": _at_a_limit(projections, valid) & ~dead & ~starved,
        STARVED: starved,
    }


def _some_views(measured: Measured) -> np.ndarray:
    """Evenly spread views, as many as keep the probe within seconds."""
    scan = measured.scan
    return evenly_spread(scan.views, max(_FEWEST_VIEWS, _MOST_RAYS // (scan.rows * scan.columns)))


def probe_rays(measured: Measured, kinds: dict[str, np.ndarray]) -> Finding:
    """Tell whether there are more bad rays of the `kinds` from :func:`bad_rays` than any scan has."""
    counts = {name: int(np.count_nonzero(mask)) for name, mask in kinds.items()}
    size = next(iter(kinds.values())).size
    shares = {name: count / size for name, count in counts.items()}
    # Zeros are recognised within the object only, so they are compared with the rays through it.
    shares[ZERO] /= max(float(np.mean(measured.filled > _THROUGH * measured.level)), shares[ZERO], 1e-9)
    listed = ", ".join(f"{100 * share:.3g} % {name}" for name, share in shares.items() if share)
    if sum(share for name, share in shares.items() if name not in (STARVED, MARKED)) > _TOLERATED:
        remedy = (
            "mark them in valid= (False is not used); correct flat fields, or saturation=, mend many of them"
        )
        return Finding(RAYS, DEFECT, listed, remedy, shares)
    doubtful = np.flatnonzero(measured.apart[1] & ~kinds[DEAD].all(axis=(0, 1)))
    if len(doubtful):
        named = ", ".join(str(column) for column in doubtful[:_NAMED])
        text = f"unlike both neighbours in all views, by the detector or what is round about the axis: column {named}"
        remedy = "a picture without the object: if a column is off there, too, mark it in valid= (False is not used)"
        return Finding(RAYS, UNKNOWN, text, remedy, shares)
    return Finding(RAYS, OK, listed or "none", "", shares)


def _starved(projections: np.ndarray, valid: np.ndarray, level: float) -> np.ndarray:
    """Invalid rays next to which hardly any light comes through either."""
    values = np.where(valid, projections, -np.inf)
    around = values.copy()
    for shift in (1, 2, 3):
        around[..., shift:] = np.maximum(around[..., shift:], values[..., :-shift])
        around[..., :-shift] = np.maximum(around[..., :-shift], values[..., shift:])
    alone = ~np.isfinite(around)
    lit = np.asarray(valid.any(axis=1))[:, None]
    # What is opaque in all views is there in all of them: a pixel that sees none among lit ones is dead.
    dead = ~lit & (~alone & (around <= _OPAQUE * level)).any(axis=1)[:, None]
    return ~valid & ~dead & ((around > _OPAQUE * level) | alone & lit)


def _dark_end(projections: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Rays clipped to one value that a reconstruction takes for opaque."""
    values = np.where(valid, projections, np.nan).astype(np.float32).swapaxes(0, 1)
    opaque = dark_end(values)[0]
    return np.zeros(valid.shape, bool) if opaque is None else opaque.swapaxes(0, 1)


def _one_photon(projections: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Rays of the largest value, where counts clipped at one photon end: the next darkest have two."""
    largest = np.max(projections, initial=0.0, where=valid)
    second = np.max(projections, initial=0.0, where=valid & (projections < largest))
    if abs(largest - second - math.log(2)) > ONE_PHOTON:
        return np.zeros(valid.shape, bool)
    return valid & (projections == largest)


def _dead_pixels(projections: np.ndarray, valid: np.ndarray, level: float) -> np.ndarray:
    """Pixels above or below all their neighbours in four views of five, or that never change, (rows, columns).

    Matter that turns with the object does not stay in one pixel. Matter that is round about the axis goes on into
    the next rows. A detector of one or two rows has no such neighbours, so its pixels must differ by more.
    """
    rows, views, columns = projections.shape
    if columns < 5 or views < 5:
        return np.zeros((rows, columns), bool)
    values = np.where(valid, projections, np.nan)
    near = _neighbours(values)
    # One neighbour after the other: eight copies of the scan would need too much memory.
    highest, lowest = reduce(np.fmax, near), reduce(np.fmin, near)
    off = np.nan_to_num(np.fmax(values - highest, 0) - np.fmax(lowest - values, 0))
    limit = (_STANDS_OUT if rows > 2 else 3 * _STANDS_OUT) * level
    low, high = np.quantile(off, [1 - _ALMOST_ALL, _ALMOST_ALL], axis=1)
    stands_out = (low > limit) | (high < -limit)
    frozen = np.nan_to_num(np.ptp(values, axis=1), nan=1.0) == 0
    lively = np.logical_and.reduce([np.nan_to_num(np.ptp(one, axis=1)) > 0 for one in near])
    return stands_out | frozen & lively


def _neighbours(values: np.ndarray) -> list[np.ndarray]:
    """The values one row and one column further, NaN beyond the detector."""
    rows, _, columns = values.shape
    padded = np.pad(values, ((1, 1), (0, 0), (1, 1)), constant_values=np.nan)
    steps = [(r, c) for r in (0, 1, 2) for c in (0, 1, 2) if (r, c) != (1, 1) and (rows > 1 or r == 1)]
    return [padded[r : r + rows, :, c : c + columns] for r, c in steps]


def _at_a_limit(projections: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Rays whose value, the largest or the smallest above zero, is also that of many other rays."""
    values = projections[valid]
    limits = [] if not values.size else [values.max(), values.min()]
    masks = [valid & (projections == limit) for limit in limits if limit != 0]
    many = [
        mask
        for mask in masks
        if np.count_nonzero(mask) > max(10, _TOLERATED * values.size)
        and _stands_out_as_value(values, float(projections[mask][0]))
    ]
    return np.logical_or.reduce(many) if many else np.zeros(valid.shape, bool)


def _stands_out_as_value(values: np.ndarray, value: float) -> bool:
    """Whether rays hold a value much more often than any other, which counts of few photons do not."""
    shown, counts = np.unique(values, return_counts=True)
    others = counts[shown != value]
    return int(counts.sum() - others.sum()) > _OFTEN * int(others.max(initial=0))
