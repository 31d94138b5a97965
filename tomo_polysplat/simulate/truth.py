"""What a phantom is on a voxel grid: its attenuation at one energy, and which voxels hold metal.

A few points tell most voxels, which lie in one part. Those that a surface may cross are sampled more finely: a
sliver of iron a tenth of a voxel thick is brighter than all else that the voxel holds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomo_polysplat.checks import require_array, require_number, require_shape
from tomo_polysplat.parallel import run_tasks
from tomo_polysplat.simulate.chords import paint_labels
from tomo_polysplat.simulate.phantom import Phantom
from tomo_polysplat.simulate.surfaces import crossed_voxels, sample_voxels

__all__ = ["voxelise_truth"]

# Points per voxel and axis that tell which voxels a surface crosses.
_COARSE = 3


# One parameter for each option that a caller names.
def voxelise_truth(
    phantom: Phantom,
    attenuation: np.ndarray,
    shape: tuple[int, int, int],
    lower: np.ndarray,
    upper: np.ndarray,
    samples: int = 9,
    planar: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Antialiased attenuation and metal mask of a phantom.

    Parameters
    ----------
    phantom : Phantom
    attenuation : (materials,)
        Mass attenuation of the phantom's materials at the wanted energy, in cm2/g.
    shape : (nz, ny, nx)
    lower, upper : (3,)
        Window of the grid as (x, y, z), in cm; y ascends with the index.
    samples : int
        Sample points per voxel and axis where a surface is near; a voxel's value is their mean.
    planar : bool
        Sample the middle plane of each slice only: the truth of a fan-beam scan, whose rays lie in that
        plane.

    Returns
    -------
    mu : (nz, ny, nx) float32, in 1/cm.
    metal : (nz, ny, nx) bool
        Voxels that metal touches: of which any sample, those on the faces too, is metal.
    """
    samples = int(require_number("samples", samples, at_least=1))
    values = require_array("attenuation", attenuation, 1)
    require_shape("attenuation", values, (len(phantom.materials),), "(materials,)")
    lower, upper = np.asarray(lower, float), np.asarray(upper, float)
    # Label 0 is empty space; label n is part n - 1.
    mu = np.array([0.0, *(p.density * values[phantom.materials.index(p.material)] for p in phantom.parts)])
    metal = np.array([False, *(p.metal and p.density > 0 for p in phantom.parts)])
    grid = _Grid(shape, lower, (upper - lower) / np.array(shape[::-1]), planar)
    solids = (*phantom.solids()[:3], np.array([part.shape.half_extent for part in phantom.parts]))
    slices = run_tasks(
        lambda k: _truth_slice(solids, mu, metal, grid, samples, k), [(k,) for k in range(shape[0])]
    )
    return np.stack([s[0] for s in slices]), np.stack([s[1] for s in slices])


@dataclass(frozen=True, eq=False)
class _Grid:
    """Voxels, and points in them: as many along x and y, and one along z where ``planar``."""

    shape: tuple[int, int, int]
    lower: np.ndarray
    voxel: np.ndarray
    planar: bool

    def points(self, samples: int) -> np.ndarray:
        """Sample points per voxel along x, y and z."""
        return np.array([samples, samples, 1 if self.planar else samples])


def _truth_slice(solids, mu, metal, grid, samples, index):
    """Attenuation and mask (ny, nx) of one slice."""
    labels = _labels(solids, grid, index)
    middle = labels[len(labels) // 2, _COARSE // 2 + 1 :: _COARSE, _COARSE // 2 + 1 :: _COARSE]
    middle = middle[: grid.shape[1], : grid.shape[2]]
    values, marks = mu[middle], metal[middle]
    crossed = np.argwhere(crossed_voxels(labels, (_COARSE, _COARSE)))
    corners = grid.lower + np.insert(crossed[:, ::-1], 2, index, axis=1) * grid.voxel
    mean, (within, touching) = np.empty(len(crossed)), np.empty((2, len(crossed)), bool)
    fixed = (grid.points(samples), solids, mu, metal)
    to_faces = np.array([True, True, not grid.planar])
    sample_voxels(corners, grid.voxel, to_faces, *fixed, False, np.empty_like(mean), touching)
    # The means of equal cells are the voxel's; its faces would count twice as much.
    sample_voxels(corners, grid.voxel, np.zeros(3, bool), *fixed, True, mean, within)
    values[tuple(crossed.T)], marks[tuple(crossed.T)] = mean, touching | within
    return values.astype(np.float32), marks


def _labels(solids, grid, index):
    """Labels of the coarse points of a slice, and of one more on every side."""
    per_voxel = grid.points(_COARSE)
    beside = np.array([1, 1, 0 if grid.planar else 1])
    step = grid.voxel / per_voxel
    start = grid.lower + np.array([0.0, 0.0, index]) * grid.voxel + (0.5 - beside) * step
    counts = np.array([grid.shape[2], grid.shape[1], 1]) * per_voxel + 2 * beside
    labels = np.zeros(counts[::-1], np.int32)
    round_axes, centres, to_local, halves = solids
    first = np.ceil((centres - halves - start) / step - 1e-6).astype(np.int64)
    last = np.floor((centres + halves - start) / step + 1e-6).astype(np.int64) + 1
    first, last = np.maximum(first, 0), np.minimum(last, counts)
    for k in np.flatnonzero((first < last).all(axis=1)):
        solid = round_axes[k], centres[k], to_local[k]
        paint_labels(labels, start, step, first[k], last[k], int(k) + 1, *solid)
    return labels
