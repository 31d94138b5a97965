"""Line integrals through voxels and their exact adjoint, for rays in any directions.

Joseph's method (IEEE Trans. Med. Imaging 1, 192, 1982, doi:10.1109/TMI.1982.4307572): step from plane to
plane of voxel centres along the axis nearest to the ray and interpolate bilinearly in each.
"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.compiled import called, njit
from tomo_polysplat.parallel import cpu_threads, run_tasks, split_range
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid

__all__ = ["JosephProjector"]


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
        volume = np.zeros(self.grid.shape, np.float32)
        slabs = slabs_of(self.grid.shape, cpu_threads())
        run_tasks(lambda axis, a, b: self._run(vectors, volume, projections, True, axis, a, b), slabs)
        return volume

    def _run(
        self,
        vectors: np.ndarray,
        volume: np.ndarray,
        projections: np.ndarray,
        adjoint: bool,
        *slab: int,
    ) -> None:
        axis, first, last = slab or (2, 0, volume.shape[0])
        cone, size = self.geometry.beam == "cone", self.grid.voxel_size
        voxels = volume.reshape(-1)
        _trace(vectors, cone, size, voxels, volume.shape, projections, adjoint, axis, first, last)


def slabs_of(shape: tuple[int, ...], parts: int) -> list[tuple[int, int, int]]:
    """A volume (nz, ny, nx) cut into slabs: axis (0 for x) and half-open range of voxels along it.

    Every voxel is in one slab, which meets the rays in the same order whichever slab it is: its sum has the same bits
    for any number of slabs.
    """
    axis = int(np.argmax(shape[:2]))
    return [(2 - axis, a, b) for a, b in split_range(shape[axis], parts)]


# Compiled: it takes arrays and numbers, and no objects that hold them.
@njit(nogil=True, cache=True, fastmath=True)
def _trace(vectors, cone, size, voxels, shape, projections, adjoint, axis, first, last):  # type: ignore[no-untyped-def]
    """Project the voxels first..last along an axis (0 for x), or add to them what is projected back."""
    counts = (shape[2], shape[1], shape[0])
    strides = (1, shape[2], shape[1] * shape[2])
    pixel, ray = np.empty(3), np.empty(3)
    for view in range(projections.shape[0]):
        source, corner, u, v = vectors[view, 0], vectors[view, 1], vectors[view, 2], vectors[view, 3]
        for i in range(projections.shape[1]):
            for j in range(projections.shape[2]):
                for c in range(3):
                    pixel[c] = corner[c] + j * u[c] + i * v[c]
                    ray[c] = pixel[c] - source[c] if cone else source[c]
                m = _longest(ray)
                a, b = (m + 1) % 3, (m + 2) % 3
                slope_a, slope_b = ray[a] / ray[m], ray[b] / ray[m]
                start_a, start_b = pixel[a] - pixel[m] * slope_a, pixel[b] - pixel[m] * slope_b
                low, high = _clip(start_a, slope_a, 0.0, float(counts[a]), 0.0, counts[m] - 1.0)
                low, high = _clip(start_b, slope_b, 0.0, float(counts[b]), low, high)
                if cone and ray[m] > 0:
                    low = max(low, source[m])
                elif cone:
                    high = min(high, source[m])
                k0, k1 = int(np.ceil(low)), int(np.floor(high)) + 1
                if adjoint:
                    k0, k1 = _within(k0, k1, axis, first, last, m, a, start_a, slope_a, start_b, slope_b)
                if k0 >= k1:
                    continue
                a0, a1 = (first, last) if a == axis else (0, counts[a])
                b0, b1 = (first, last) if b == axis else (0, counts[b])
                ahead, right, up = strides[m], strides[a], strides[b]
                square = (ray[0] * size[0]) ** 2 + (ray[1] * size[1]) ** 2 + (ray[2] * size[2]) ** 2
                length = np.sqrt(square) / abs(ray[m])
                value = projections[view, i, j] * length
                total = 0.0
                for k in range(k0, k1):
                    pa, pb = start_a + k * slope_a, start_b + k * slope_b
                    ia, ib = int(np.floor(pa)), int(np.floor(pb))
                    fa, fb = pa - ia, pb - ib
                    at = k * ahead + ia * right + ib * up
                    if a0 <= ia and ia + 1 < a1 and b0 <= ib and ib + 1 < b1:
                        # All four, as nearly always; an index without a sign is not asked if it counts from the end.
                        ea, eb = 1.0 - fa, 1.0 - fb
                        v00, v01 = np.uint64(at), np.uint64(at + up)
                        v10, v11 = np.uint64(at + right), np.uint64(at + right + up)
                        if adjoint:
                            voxels[v00] += ea * eb * value
                            voxels[v01] += ea * fb * value
                            voxels[v10] += fa * eb * value
                            voxels[v11] += fa * fb * value
                        else:
                            total += ea * eb * voxels[v00]
                            total += ea * fb * voxels[v01]
                            total += fa * eb * voxels[v10]
                            total += fa * fb * voxels[v11]
                        continue
                    for da in range(2):
                        if a0 <= ia + da < a1:
                            wa = fa if da else 1.0 - fa
                            for db in range(2):
                                if b0 <= ib + db < b1:
                                    weight = wa * (fb if db else 1.0 - fb)
                                    voxel = at + da * right + db * up
                                    if adjoint:
                                        voxels[voxel] += weight * value
                                    else:
                                        total += weight * voxels[voxel]
                if not adjoint:
                    projections[view, i, j] = total * length


@called()
def _longest(ray):  # type: ignore[no-untyped-def]
    """The axis along which a ray goes farthest, the first of equals."""
    x, y, z = abs(ray[0]), abs(ray[1]), abs(ray[2])
    if x >= y and x >= z:
        return 0
    return 1 if y >= z else 2


# Compiled: it takes arrays and numbers, and no objects that hold them.
@called()
def _within(k0, k1, axis, first, last, m, a, start_a, slope_a, start_b, slope_b):  # type: ignore[no-untyped-def]
    """The steps k0..k1 that may touch a slab; some beside it may be among them."""
    if m == axis:
        return max(k0, first), min(k1, last)
    start, slope = (start_a, slope_a) if a == axis else (start_b, slope_b)
    low, high = _clip(start, slope, float(first), float(last), float(k0), float(k1))
    # Outwards, as rounding must not decide.
    return max(k0, int(np.floor(low))), min(k1, int(np.ceil(high)) + 1)


@called()
def _clip(start, slope, first, last, low, high):  # type: ignore[no-untyped-def]
    """The part of ``low .. high`` where ``start + k slope`` is within a voxel of those from first to last."""
    if abs(slope) < 1e-12:
        return (low, high) if first - 1.0 < start < last else (1.0, 0.0)
    k0, k1 = (first - 1.0 - start) / slope, (last - start) / slope
    return max(low, min(k0, k1)), min(high, max(k0, k1))
