"""How many views see each voxel: what no ray sees is not measured, which is something else than air."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.scan.view_geometry import Geometry
from tomo_polysplat.scan.volume_grid import VolumeGrid

__all__ = ["coverage", "unseen_share"]

# Voxels that are looked at together, so that what is worked out of them stays in cache.
_AT_ONCE = 1 << 16
# Voxels along an axis, and views, that tell how much of a volume is seen.
_FEW_VOXELS, _FEW_VIEWS = 24, 45


def coverage(
    geometry: Geometry, grid: VolumeGrid, pixels: np.ndarray | None = None, most_views: int = 90
) -> np.ndarray:
    """Share of the views that see the centre of each voxel.

    Parameters
    ----------
    geometry, grid
        Where the rays run, and the voxels.
    pixels : bool array, shape (rows, columns), optional
        Pixels that measure; None means all.
    most_views : int
        So many views, evenly spread, are looked at.

    Returns
    -------
    float32 array, shape (z, y, x)
        From 0, not measured, to 1.
    """
    some, (x, y, z) = _looked_at(geometry, grid, most_views)
    pixels, views = None if pixels is None or pixels.all() else pixels, _matrices(some)
    layers = max(1, _AT_ONCE // (len(x) * len(y)))
    seen = np.zeros(grid.shape, np.float32)
    for first in range(0, len(z), layers):
        part, places = seen[first : first + layers], (x, y[:, None], z[first : first + layers, None, None])
        for view in views:
            part += _sees(some, view, places, pixels)
    return seen / some.views


def unseen_share(geometry: Geometry, grid: VolumeGrid, pixels: np.ndarray | None = None) -> float:
    """Share of the volume that no view sees, by some voxels and views of it; see `coverage`."""
    slices, rows, columns = (min(n, _FEW_VOXELS) for n in grid.shape)
    coarse = VolumeGrid((slices, rows, columns), grid.lower, grid.upper)
    some, (x, y, z) = _looked_at(geometry, coarse, _FEW_VIEWS)
    pixels = None if pixels is None or pixels.all() else pixels
    unseen = tuple(along.ravel() for along in np.meshgrid(x, y, z))
    for view in _matrices(some):
        if not len(unseen[0]):
            break
        left = ~_sees(some, view, unseen, pixels)
        unseen = tuple(along[left] for along in unseen)
    return len(unseen[0]) / (slices * rows * columns)


def _looked_at(
    geometry: Geometry, grid: VolumeGrid, most: int
) -> tuple[Geometry, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """So many views at most, evenly spread, and the voxels' places along x, y and z."""
    x, y, z = grid.axes()
    if geometry.planar:
        # A fan sees its plane, whatever height its pixels are told to have.
        z = np.full_like(z, float(geometry.centre[0, 2]))
    return geometry.select(evenly_spread(geometry.views, most)), (x, y, z)


def _matrices(geometry: Geometry) -> list[tuple[np.ndarray, np.ndarray]]:
    """Of each view, what takes places to the detector, and from where."""
    return list(zip(*geometry.projection_matrices()))


def _sees(
    geometry: Geometry,
    view: tuple[np.ndarray, np.ndarray],
    places: tuple[np.ndarray, ...],
    pixels: np.ndarray | None,
) -> np.ndarray:
    """Whether a view sees each place, of arrays x, y and z that are broadcast; with one of the ``pixels``, if told."""
    matrix, reference = view
    x, y, z = (along - origin for along, origin in zip(places, reference))
    # Sums of what the axes add: a product of such narrow matrices leaves BLAS's threads waiting for each other.
    column, row, depth = (a * x + b * y + c * z for a, b, c in matrix)
    if geometry.beam == "cone":
        depth[depth <= 0] = np.nan
        column, row = column / depth, row / depth
    column, row = column + 0.5, row + 0.5
    inside = (column >= 0) & (column < geometry.columns) & (row >= 0) & (row < geometry.rows)
    if pixels is not None:
        inside[inside] = pixels[row[inside].astype(int), column[inside].astype(int)]
    return inside
