"""Backprojection for filtered projections: every voxel looks up its own place on the detector."""

from __future__ import annotations

import numpy as np
from numba import njit

from tomo_polysplat.parallel import cpu_threads, run_tasks, split_range
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid

__all__ = ["accumulate", "voxel_maps"]


def voxel_maps(geometry: Geometry, grid: VolumeGrid) -> np.ndarray:
    """Affine maps ``(ix, iy, iz, 1) -> (alpha, beta, gamma)``, (views, 3, 4) float64.

    A voxel falls on column ``alpha / gamma`` and row ``beta / gamma``, magnified ``1 / gamma`` times.
    """
    inverse, reference = geometry.projection_matrices()
    first = grid.lower + 0.5 * grid.voxel_size - reference
    constant = np.einsum("vkl,vl->vk", inverse, first)
    maps = np.concatenate([inverse * grid.voxel_size, constant[..., None]], axis=2)
    if geometry.beam == "parallel":
        maps[:, 2] = (0.0, 0.0, 0.0, 1.0)
    return maps


def accumulate(volume: np.ndarray, filtered: np.ndarray, maps: np.ndarray) -> None:
    """Add the backprojection of some views to a volume, weighted by the squared magnification.

    Parameters
    ----------
    volume : (nz, ny, nx) float32
        Added to in place.
    filtered : (views, rows, columns) float32
        Read bilinearly; beyond its edge, the edge.
    maps : (views, 3, 4)
        From `voxel_maps`.
    """
    lines = volume.reshape(-1, volume.shape[2])
    parts = split_range(len(lines), 4 * cpu_threads())
    run_tasks(_add_lines, [(lines, volume.shape[1], filtered, maps, a, b) for a, b in parts])


@njit(nogil=True, cache=True, fastmath=True)
def _add_lines(lines, ny, filtered, maps, first, last):  # type: ignore[no-untyped-def]
    views, rows, columns = filtered.shape
    last_row, last_column = np.float32(rows - 1), np.float32(columns - 1)
    zero, one = np.float32(0), np.float32(1)
    for line in range(first, last):
        z, y = line // ny, line % ny
        target = lines[line]
        for view in range(views):
            m = maps[view]
            a0 = np.float32(m[0, 1] * y + m[0, 2] * z + m[0, 3])
            b0 = np.float32(m[1, 1] * y + m[1, 2] * z + m[1, 3])
            g0 = np.float32(m[2, 1] * y + m[2, 2] * z + m[2, 3])
            a1, b1, g1 = np.float32(m[0, 0]), np.float32(m[1, 0]), np.float32(m[2, 0])
            image = filtered[view]
            for x in range(target.size):
                gamma = g0 + x * g1
                # At or behind the source there is nothing to look up.
                kappa = one / gamma if gamma > np.float32(1e-3) else zero
                column = min(max((a0 + np.float32(x) * a1) * kappa, zero), last_column)
                row = min(max((b0 + np.float32(x) * b1) * kappa, zero), last_row)
                j, i = np.int32(column), np.int32(row)
                fj, fi = column - np.float32(j), row - np.float32(i)
                j1, i1 = min(j + 1, columns - 1), min(i + 1, rows - 1)
                near = image[i, j] + fj * (image[i, j1] - image[i, j])
                far = image[i1, j] + fj * (image[i1, j1] - image[i1, j])
                target[x] += kappa * kappa * (near + fi * (far - near))
