"""Where no matter can be told: behind a source, or so near that a Gaussian would reach its plane.

Rays start at the source. A Gaussian that reaches the plane through a source, parallel to its detector, has no
projection in that view and is left out of it. Matter there would be missing in some views and present in others,
and the difference would be explained by inventing matter elsewhere.
"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.scan.geometry import Geometry, VolumeGrid

__all__ = ["beyond_sources"]

# Deviations of a unit normal from the plane z = 0 below which an orbit is flat, and one slice speaks for all.
_FLAT = 1e-9


def beyond_sources(geometry: Geometry, grid: VolumeGrid, margin: float) -> np.ndarray | None:
    """Voxels that some source plane leaves behind it, or in front of it by less than a margin.

    Parameters
    ----------
    geometry, grid : Geometry, VolumeGrid
    margin : float
        In the unit of length of both.

    Returns
    -------
    (nz, ny, nx) bool array, or None
        None where there is no such voxel, as in any scan from a distance and in every parallel beam.
    """
    if geometry.beam == "parallel":
        return None
    inverse, source = geometry.projection_matrices()
    normal = inverse[:, 2] / np.linalg.norm(inverse[:, 2], axis=1, keepdims=True)
    offset = np.einsum("vk,vk->v", normal, source) + margin
    corners = np.stack(np.meshgrid(*zip(grid.lower, grid.upper), indexing="ij"), -1).reshape(-1, 3)
    near = (normal @ corners.T).min(axis=1) < offset
    if not near.any():
        return None
    x, y, z = grid.axes()
    flat = bool((np.abs(normal[:, 2]) < _FLAT).all())
    behind = np.zeros((1 if flat else len(z), len(y), len(x)), bool)
    for (a, b, c), least in zip(normal[near], offset[near]):
        behind |= c * z[: len(behind), None, None] + b * y[:, None] + a * x < least
    return np.broadcast_to(behind, grid.shape) if behind.any() else None
