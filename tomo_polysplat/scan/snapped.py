"""Round coordinates, so that one scan in two units has the same ones.

Without this they differ in the last bit, and a fit of many steps makes that a difference of a thousandth.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tomo_polysplat.scan.view_geometry import Geometry
from tomo_polysplat.scan.volume_grid import VolumeGrid

__all__ = ["snapped_geometry", "snapped_grid"]


def snapped_grid(grid: VolumeGrid) -> VolumeGrid:
    """A grid with rounded faces."""
    return VolumeGrid(grid.shape, *_snapped(np.stack([grid.lower, grid.upper])))


def snapped_geometry(geometry: Geometry) -> Geometry:
    """A geometry with rounded vectors, its beam of length 1 where it is parallel."""
    origin = geometry.origin
    if geometry.beam == "parallel":
        origin = origin / np.linalg.norm(origin, axis=1, keepdims=True)
    origin, corner, u, v = map(_snapped, (origin, geometry.corner, geometry.u, geometry.v))
    return replace(geometry, origin=origin, corner=corner, u=u, v=v)


def _snapped(vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) rounded to 32 bits of their longest coordinate, a millionth of a pixel."""
    longest = np.abs(vectors).max(axis=1, keepdims=True)
    # A little above each power of two, so that a length of 1 and of 1 - 1e-16 are rounded alike.
    exponent = np.floor(np.log2(longest, where=longest > 0, out=np.zeros_like(longest)) + 1e-6).astype(int)
    return np.ldexp(np.rint(np.ldexp(vectors, 32 - exponent)), exponent - 32)
