"""What a phantom is on a voxel grid: its attenuation at one energy, and which voxels hold metal."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.checks import require_array, require_number, require_shape
from tomo_polysplat.parallel import run_tasks
from tomo_polysplat.simulate.chords import paint_labels
from tomo_polysplat.simulate.phantom import Phantom

__all__ = ["voxelise_truth"]


def voxelise_truth(
    phantom: Phantom,
    attenuation: np.ndarray,
    shape: tuple[int, int, int],
    lower: np.ndarray,
    upper: np.ndarray,
    samples: int = 3,
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
        Sample points per voxel and axis; a voxel's value is their mean.
    planar : bool
        Sample the middle plane of each slice only: the truth of a fan-beam scan, whose rays lie in that
        plane.

    Returns
    -------
    mu : (nz, ny, nx) float32, in 1/cm.
    metal : (nz, ny, nx) bool
        Voxels of which any sample is metal.
    """
    samples = int(require_number("samples", samples, at_least=1))
    values = require_array("attenuation", attenuation, 1)
    require_shape("attenuation", values, (len(phantom.materials),), "(materials,)")
    # Label 0 is empty space; label n is part n - 1.
    mu = np.array([0.0, *(p.density * values[phantom.materials.index(p.material)] for p in phantom.parts)])
    metal = np.array([False, *(p.metal and p.density > 0 for p in phantom.parts)])
    per_voxel = np.array([samples, samples, 1 if planar else samples])
    voxel = (np.asarray(upper, float) - lower) / np.array(shape[::-1])
    slice_window = (np.asarray(lower, float), voxel, per_voxel)
    slices = run_tasks(
        lambda k: _truth_slice(phantom, mu, metal, shape, slice_window, k), [(k,) for k in range(shape[0])]
    )
    return np.stack([s[0] for s in slices]), np.stack([s[1] for s in slices])


def _truth_slice(phantom, mu, metal, shape, window, index):
    """Attenuation and mask (ny, nx) of one slice, from the labels of its sample points."""
    lower, voxel, per_voxel = window
    step = voxel / per_voxel
    start = lower + np.array([0.0, 0.0, index]) * voxel + step / 2
    counts = np.array([shape[2], shape[1], 1]) * per_voxel
    labels = np.zeros(counts[::-1], np.int32)
    for label, part in enumerate(phantom.parts, start=1):
        solid = part.shape
        first = np.ceil((solid.centre - solid.half_extent - start) / step - 1e-6).astype(np.int64)
        last = np.floor((solid.centre + solid.half_extent - start) / step + 1e-6).astype(np.int64) + 1
        first, last = np.maximum(first, 0), np.minimum(last, counts)
        if (first < last).all():
            paint_labels(
                labels, start, step, first, last, label, solid.round_axes, solid.centre, solid.to_local
            )
    nx, ny, nz = per_voxel
    blocks = labels.reshape(nz, shape[1], ny, shape[2], nx)
    return mu[blocks].mean(axis=(0, 2, 4)).astype(np.float32), metal[blocks].any(axis=(0, 2, 4))
