"""Line integrals through voxels and their exact adjoint, for rays in any directions.

Joseph's method (IEEE Trans. Med. Imaging 1, 192, 1982, doi:10.1109/TMI.1982.4307572): step from plane to
plane of voxel centres along the axis nearest to the ray and interpolate bilinearly in each.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from tomo_polysplat.parallel import cpu_threads, run_tasks, split_range
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid

__all__ = ["JosephProjector"]

# Memory for the adjoint's private copies of the volume, one a thread.
_COPIES_BYTES = 2 * 1024**3


class JosephProjector:
    """The linear map from a volume to its projections, and its adjoint.

    Parameters
    ----------
    geometry, grid : Geometry, VolumeGrid
        Any of ours: no orbit is assumed.
    """

    def __init__(self, geometry: Geometry, grid: VolumeGrid) -> None:
        self.geometry, self.grid = geometry, grid
        size = grid.voxel_size
        first = grid.lower + 0.5 * size
        cone = geometry.beam == "cone"
        origin = (geometry.origin - first if cone else geometry.origin) / size
        # Everything in units of voxels, with the centre of voxel (0, 0, 0) at 0: (views, 4, 3).
        vectors = [origin, (geometry.corner - first) / size, geometry.u / size, geometry.v / size]
        self._vectors = np.ascontiguousarray(np.stack(vectors, axis=1))

    def forward(self, volume: np.ndarray, views: np.ndarray | None = None) -> np.ndarray:
        """Projections (views, rows, columns) float32 of a volume (nz, ny, nx) float32.

        ``views`` are indices of the views wanted; None means all.
        """
        vectors = self._vectors if views is None else self._vectors[views]
        projections = np.zeros((len(vectors), self.geometry.rows, self.geometry.columns), np.float32)
        volume = np.ascontiguousarray(volume, dtype=np.float32)
        parts = split_range(len(vectors), 4 * cpu_threads())
        run_tasks(self._run, [(vectors[a:b], volume, projections[a:b], False) for a, b in parts])
        return projections

    def adjoint(self, projections: np.ndarray, views: np.ndarray | None = None) -> np.ndarray:
        """The volume (nz, ny, nx) float32 with ``<forward(x), p> = <x, adjoint(p)>``."""
        vectors = self._vectors if views is None else self._vectors[views]
        projections = np.ascontiguousarray(projections, dtype=np.float32)
        copies = max(1, min(cpu_threads(), _COPIES_BYTES // (4 * int(np.prod(self.grid.shape)))))

        def spread(a: int, b: int) -> np.ndarray:
            volume = np.zeros(self.grid.shape, np.float32)
            self._run(vectors[a:b], volume, projections[a:b], True)
            return volume

        volumes = run_tasks(spread, split_range(len(vectors), copies))
        for other in volumes[1:]:
            volumes[0] += other
        return volumes[0]

    def _run(self, vectors: np.ndarray, volume: np.ndarray, projections: np.ndarray, adjoint: bool) -> None:
        size = self.grid.voxel_size
        _trace(
            vectors,
            self.geometry.beam == "cone",
            size,
            volume.reshape(-1),
            volume.shape,
            projections,
            adjoint,
        )


@njit(nogil=True, cache=True, fastmath=True)
def _trace(vectors, cone, size, voxels, shape, projections, adjoint):  # type: ignore[no-untyped-def]
    counts = (shape[2], shape[1], shape[0])
    strides = (1, shape[2], shape[1] * shape[2])
    for view in range(projections.shape[0]):
        source, corner, u, v = vectors[view]
        for i in range(projections.shape[1]):
            for j in range(projections.shape[2]):
                pixel = corner + j * u + i * v
                ray = pixel - source if cone else source
                m = np.argmax(np.abs(ray))
                a, b = (m + 1) % 3, (m + 2) % 3
                slope_a, slope_b = ray[a] / ray[m], ray[b] / ray[m]
                start_a, start_b = pixel[a] - pixel[m] * slope_a, pixel[b] - pixel[m] * slope_b
                low, high = _clip(start_a, slope_a, counts[a], 0.0, counts[m] - 1.0)
                low, high = _clip(start_b, slope_b, counts[b], low, high)
                if cone and ray[m] > 0:
                    low = max(low, source[m])
                elif cone:
                    high = min(high, source[m])
                length = np.sqrt(np.sum((ray * size) ** 2)) / abs(ray[m])
                value = projections[view, i, j] * length
                total = 0.0
                for k in range(int(np.ceil(low)), int(np.floor(high)) + 1):
                    pa, pb = start_a + k * slope_a, start_b + k * slope_b
                    ia, ib = int(np.floor(pa)), int(np.floor(pb))
                    fa, fb = pa - ia, pb - ib
                    at = k * strides[m] + ia * strides[a] + ib * strides[b]
                    for da in range(2):
                        if 0 <= ia + da < counts[a]:
                            wa = fa if da else 1.0 - fa
                            for db in range(2):
                                if 0 <= ib + db < counts[b]:
                                    weight = wa * (fb if db else 1.0 - fb)
                                    voxel = at + da * strides[a] + db * strides[b]
                                    if adjoint:
                                        voxels[voxel] += weight * value
                                    else:
                                        total += weight * voxels[voxel]
                if not adjoint:
                    projections[view, i, j] = total * length


@njit(nogil=True, cache=True)
def _clip(start, slope, count, low, high):  # type: ignore[no-untyped-def]
    """The part of ``low .. high`` where ``start + k slope`` is within a voxel of the volume."""
    if abs(slope) < 1e-12:
        return (low, high) if -1.0 < start < count else (1.0, 0.0)
    k0, k1 = (-1.0 - start) / slope, (count - start) / slope
    return max(low, min(k0, k1)), min(high, max(k0, k1))
