"""Sort the views, so that a volume does not depend on the order in which they come."""

from __future__ import annotations

from typing import Any

import numpy as np

from tomo_polysplat.scan.view_geometry import Geometry

__all__ = ["of_same_geometry", "sorted_in_place", "view_order"]


def view_order(geometry: Geometry, projections: Any) -> np.ndarray:
    """Indices (views,) that sort the views by angle, or along the axis where the scanner moves along it.

    A fit draws views at random, chooses held-out rays by the number of their view, and adds up floats. All of this
    depends on the order of the views; with sorted views one scan gives one volume.

    Parameters
    ----------
    geometry : Geometry
        Angles are taken about z through the origin, from ASTRA's angle of zero.
    projections : array (views, rows, columns), or what gives (rows, columns) by the number of a view
        Their sums order views of the same geometry (`of_same_geometry`), such as those at 0 and 360 degrees.
    """
    keys, same = _keys(geometry), of_same_geometry(geometry)
    if not same.any():
        return np.lexsort(keys)
    sums = np.zeros(geometry.views)
    for view in np.flatnonzero(same):
        sums[view] = np.nansum(projections[view], dtype=np.float64)
    return np.lexsort([sums, *keys])


def of_same_geometry(geometry: Geometry) -> np.ndarray:
    """(views,) whether another view has the same geometry."""
    order, vectors = np.lexsort(_keys(geometry)), _vectors(geometry)
    same = (vectors[order[1:]] == vectors[order[:-1]]).all(axis=1)
    found = np.zeros(geometry.views, bool)
    found[order] = np.append(same, False) | np.insert(same, 0, False)
    return found


def _vectors(geometry: Geometry) -> np.ndarray:
    return np.hstack([geometry.origin, geometry.corner, geometry.u, geometry.v])


def _keys(geometry: Geometry) -> list[np.ndarray]:
    """What views are sorted by, the first of which counts least."""
    angle = np.mod(np.arctan2(geometry.origin[:, 0], -geometry.origin[:, 1]), 2 * np.pi)
    height = geometry.centre[:, 2]
    # Turns of a helix stay apart. If they alternated, a subset of the views could see one turn only.
    moves = np.ptp(height) > geometry.rows * np.median(np.linalg.norm(geometry.v, axis=1))
    return [*_vectors(geometry).T[::-1], angle, height if moves else np.zeros_like(height)]


def sorted_in_place(projections: np.ndarray, order: np.ndarray) -> None:
    """Put the views of (views, ...) projections in an order, with room for one view more."""
    done = np.arange(len(order)) == order
    for start in range(len(order)):
        if done[start]:
            continue
        first, at = projections[start].copy(), start
        while order[at] != start:
            projections[at] = projections[order[at]]
            done[at] = True
            at = order[at]
        projections[at] = first
        done[at] = True
