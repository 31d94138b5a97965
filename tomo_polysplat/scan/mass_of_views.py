"""How much of a spectrum's hardening the rays of a parallel beam show, told by the mass that every view sees.

Rays of one direction pass the whole of a slice once, so line integrals add up to its mass in every view (the condition
of order zero of Helgason 1965 and Ludwig 1966, doi:10.1002/cpa.3160190207). Values that harden do not: they add up to
less where the object looks narrow and thick. Which values add up to the same tells whether they have been corrected.
Neither a volume nor a fit is needed, and an axis that is off changes nothing.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.water import areal_density
from tomo_polysplat.scan.filling import fill_rows_in_place
from tomo_polysplat.scan.view_geometry import Geometry

__all__ = ["HardeningShown", "hardening_shown"]

# Every row adds up by itself, so that some of them tell.
_ROWS = 16
# Parts of half a turn, each of which is left out once; views in each.
_PARTS, _FEWEST = 8, 3
# Share of the largest value that the outermost columns may show of an object that the detector sees the whole of.
_EDGE = 0.05
# Of a right angle; rays that are not across the rows' axis see other slices from view to view.
_ACROSS = 1e-6


class HardeningShown(NamedTuple):
    """How much of the hardening that a spectrum gives water is seen.

    Attributes
    ----------
    share : float
        0: the values are linear already, as after a scanner's correction, or of one energy. 1: as the spectrum says.
    error : float
        Its standard error (jackknife over parts of half a turn).
    """

    share: float
    error: float

    @property
    def none(self) -> bool:
        """Whether the rays are nearer to none than to the spectrum's, three errors considered."""
        return abs(self.share) + 3.0 * self.error < 0.5


def hardening_shown(values: Any, geometry: Geometry, spectrum: Spectrum) -> HardeningShown | None:
    """The share of a spectrum's hardening that makes all views see the same mass.

    Parameters
    ----------
    values : (views, rows, columns) array
        -log(I/I0), of which some rows are read; NaN where a ray is not to be used.
    geometry : Geometry
    spectrum : Spectrum

    Returns
    -------
    HardeningShown or None
        None where it cannot be told: no parallel beam across the rotation axis, an object that reaches beyond the
        detector, or too few views. Metal hardens more than water: the share is then off, mostly far below 0.
    """
    if not _sees_slices(geometry):
        return None
    rows = evenly_spread(geometry.rows, _ROWS)
    some = np.asarray(values[:, rows], dtype=np.float64).copy()
    flat = some.reshape(-1, geometry.columns)
    finite = np.isfinite(flat)
    if not finite.all():
        fill_rows_in_place(flat, finite)
    edges = np.abs(np.median(some[:, :, [0, -1]], axis=0))
    if not edges.max() < _EDGE * some.max():
        return None
    given, water = some.sum(axis=(1, 2)), areal_density(some, spectrum).sum(axis=(1, 2))
    if not (given.mean() > 0 and water.mean() > 0):
        return None
    direction = np.arctan2(geometry.origin[:, 1], geometry.origin[:, 0])
    part = np.minimum((np.mod(direction, np.pi) / np.pi * _PARTS).astype(int), _PARTS - 1)
    if np.bincount(part, minlength=_PARTS).min() < _FEWEST:
        return None
    given, water = given / given.mean(), water / water.mean()
    without = np.array([_share(given[part != k], water[part != k]) for k in range(_PARTS)])
    error = float(np.sqrt((_PARTS - 1) * np.mean((without - without.mean()) ** 2)))
    found = HardeningShown(_share(given, water), error)
    return found if np.isfinite(found).all() else None


def _share(given: np.ndarray, water: np.ndarray) -> float:
    """The mixture of both, ``given + share (water - given)``, that differs least from view to view."""
    given = given - given.mean()
    change = water - water.mean() - given
    square = float(change @ change)
    return -float(given @ change) / square if square > 0 else np.nan


def _sees_slices(geometry: Geometry) -> bool:
    """Whether rays are parallel and across the detector's columns, which all stand along one axis."""
    if geometry.beam != "parallel":
        return False
    along = geometry.v / np.linalg.norm(geometry.v, axis=1, keepdims=True)
    rays = geometry.origin / np.linalg.norm(geometry.origin, axis=1, keepdims=True)
    upright = np.abs(along - [0.0, 0.0, 1.0]).max() < _ACROSS
    return bool(upright and np.abs(np.einsum("vk,vk->v", along, rays)).max() < _ACROSS)
