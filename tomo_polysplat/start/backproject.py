"""Backprojection for filtered projections: every voxel looks up its own place on the detector."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.compiled import njit
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
    # Steps to the next column and row, and the last place from which there is a next one: the largest float
    # below the last index, so that no index needs a test of its own.
    right, down = min(1, columns - 1), columns if rows > 1 else 0
    last_column = max(np.float32(columns - 1) * np.float32(1 - 1e-7), np.float32(0))
    last_row = max(np.float32(rows - 1) * np.float32(1 - 1e-7), np.float32(0))
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
            pixels = filtered[view].ravel()
            for x in range(target.size):
                fx = np.float32(x)
                gamma = g0 + fx * g1
                # At or behind the source there is nothing to look up.
                kappa = one / gamma if gamma > np.float32(1e-3) else zero
                column = min(max((a0 + fx * a1) * kappa, zero), last_column)
                row = min(max((b0 + fx * b1) * kappa, zero), last_row)
                j, i = np.int32(column), np.int32(row)
                fj, fi = column - np.float32(j), row - np.float32(i)
                at = np.int64(i) * columns + j
                near = pixels[at] + fj * (pixels[at + right] - pixels[at])
                at += down
                far = pixels[at] + fj * (pixels[at + right] - pixels[at])
                target[x] += kappa * kappa * (near + fi * (far - near))
