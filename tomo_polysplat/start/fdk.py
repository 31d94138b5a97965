"""Filtered backprojection: parallel, fan and circular cone beams."""

from __future__ import annotations

import numpy as np
import torch

from tomo_polysplat.checks import require_array, require_choice, require_shape
from tomo_polysplat.parallel import run_tasks, split_range
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.backproject import accumulate, voxel_maps
from tomo_polysplat.start.fdk_by_ranks import fdk_by_ranks
from tomo_polysplat.start.filters import FILTERS, filter_rows
from tomo_polysplat.start.level import Level, LevelRows
from tomo_polysplat.start.orbit import Orbit, find_orbit
from tomo_polysplat.start.shadow import corners_of, margins, slices_seen
from tomo_polysplat.start.weights import (
    object_fan,
    object_radius,
    pixel_weights,
    ray_arcs,
    ray_offsets,
    reach,
)

__all__ = ["fdk", "fits_fdk"]

# Views filtered and backprojected together: few enough to stay in cache, enough to share out over threads.
_CHUNK = 32
# Parts of those that are filtered side by side, at most, and pixels of one, at least. They are the same for any number
# of threads, as rows go through a transform by vectors.
_PARTS, _FILTERED = 8, 1 << 15
# Share of the object's radius, or of the detector's longer side, that its shorter side must reach in part of a
# turn, where no other view has the lines beyond. Of discs that fill the window the error at 0.8 and 0.67 is 9 and
# 15 %, that of SIRT 6 %; but most objects are smaller than their window, and a large SIRT is coarse.
_SHORTER_SIDE = 0.75
# Of an arc, radians.
_ROUNDING = 1e-9


def fits_fdk(geometry: Geometry, grid: VolumeGrid) -> tuple[bool, str]:
    """Whether filtered backprojection suits a scan, and why (not).

    It wants a circular orbit about an axis parallel to z, a detector tilted little, and every line through the
    object measured at least once; in part of a turn that takes a detector that sees both sides of it.
    """
    orbit, reason = find_orbit(geometry)
    if orbit is None:
        return False, reason
    if np.hypot(*(grid.centre[:2] - orbit.axis)) > 0.5 * orbit.radius:
        return False, "the volume lies far off the axis of rotation"
    level = Level(geometry).geometry
    low, high = reach(level, orbit)
    shorter, longer = np.sort([-low, high])
    if orbit.full:
        if shorter <= 0:
            return False, "the detector does not reach the shadow of the axis of rotation"
        return True, f"{reason}, full turn"
    arc, step = np.rad2deg(orbit.arc), orbit.steps.max()
    needed = np.pi
    if geometry.beam == "cone":
        offsets = ray_offsets(level, orbit, (0, geometry.columns - 1))
        seen = np.arcsin(min(np.abs(offsets).max() / orbit.radius, 1.0))
        fan = 2 * min(seen, object_fan(grid, orbit))
        # A fan narrower than half a step is as good as a parallel beam.
        needed += fan if fan > 0.5 * step else 0.0
    if orbit.arc + step < needed - _ROUNDING:
        return False, f"{arc:.0f} degrees of arc where {np.rad2deg(needed):.0f} are needed"
    if shorter < _SHORTER_SIDE * min(longer, object_radius(grid, orbit)):
        return False, f"in {arc:.0f} degrees of arc the detector sees little more than one side of the object"
    return True, f"{reason}, {arc:.0f} degrees of arc"


def fdk(
    projections: np.ndarray,
    geometry: Geometry,
    grid: VolumeGrid,
    *,
    filter_name: str = "ram-lak",
    device: str = "cpu",
) -> np.ndarray:
    """Reconstruct by filtered backprojection.

    Parameters
    ----------
    projections : (views, rows, columns) float32
        ``-log(I / I0)``, finite.
    geometry, grid : Geometry, VolumeGrid
        A scan for which `fits_fdk` holds: parallel or fan or cone beam, full turn or part of one, views at
        any angles in any order, detector centred or not, pixels and voxels of any proportions.
    filter_name : {"ram-lak", "shepp-logan", "cosine", "hamming", "hann"}
        Ramp filter, from sharp to smooth.
    device : {"cpu", "cuda"}
        On ``"cuda"`` a 3D scan is done there (`fdk_cuda`), else on the CPU.

    Returns
    -------
    (nz, ny, nx) float32
        Attenuation per unit of length, not clipped. Slices that most views do not see are zero.

    Raises
    ------
    ValueError
        If the shapes disagree or the scan does not fit; the message says why.
    """
    projections = require_array("projections", projections, ndim=3)
    require_shape("projections", projections, geometry.shape, "(views, rows, columns)")
    require_choice("filter_name", filter_name, FILTERS)
    fits, reason = fits_fdk(geometry, grid)
    orbit, _ = find_orbit(geometry)
    if orbit is None or not fits:
        raise ValueError(f"filtered backprojection does not fit this scan: {reason}; use sirt instead")
    if device.startswith("cuda"):
        from tomo_polysplat.start.astra_fdk import suits_fdk_cuda
        from tomo_polysplat.start.slabs import fdk_cuda

        if suits_fdk_cuda(geometry)[0]:
            return fdk_cuda(projections, geometry, grid, orbit, filter_name=filter_name, device=device)
    shared = fdk_by_ranks(_slab_on_cpu, projections, geometry, grid, orbit, filter_name)
    if shared is not None:
        return shared.numpy()
    return _fdk_cpu(projections, geometry, grid, orbit, filter_name)


def _slab_on_cpu(
    projections: torch.Tensor | LevelRows,
    geometry: Geometry,
    grid: VolumeGrid,
    orbit: Orbit,
    filter_name: str,
) -> torch.Tensor:
    return torch.from_numpy(_fdk_cpu(projections[:].numpy(), geometry, grid, orbit, filter_name))


def _fdk_cpu(
    projections: np.ndarray, geometry: Geometry, grid: VolumeGrid, orbit: Orbit, filter_name: str
) -> np.ndarray:
    level = Level(geometry)
    flat = level.geometry
    arcs = ray_arcs(flat, orbit, grid)
    before, after = margins(flat, corners_of(grid))
    maps = voxel_maps(flat, grid)
    # Columns are counted from the first one kept, so that the map must move by as many.
    maps[:, 0] += before * maps[:, 2]
    volume = np.zeros(grid.shape, np.float32)
    for start in range(0, geometry.views, _CHUNK):
        chunk = slice(start, min(start + _CHUNK, geometry.views))

        def prepare(a: int, b: int) -> np.ndarray:
            weighted = _seen(projections, level, slice(a, b)) * pixel_weights(flat, orbit, arcs, slice(a, b))
            return filter_rows(weighted, filter_name, before, after)

        pixels = (chunk.stop - chunk.start) * flat.rows * flat.columns
        parts = split_range(chunk.stop - chunk.start, min(pixels // _FILTERED, _PARTS))
        filtered = run_tasks(prepare, [(start + a, start + b) for a, b in parts])
        accumulate(volume, np.concatenate(filtered), maps[chunk])
    volume[~slices_seen(geometry, grid, orbit)] = 0.0
    return volume


def _seen(projections: np.ndarray, level: Level, views: slice) -> np.ndarray:
    """What the level detector sees in some views."""
    if not level.moved:
        return projections[views]
    # A copy: what the caller gave may not be written to, of which torch warns.
    told = torch.from_numpy(projections[views].copy())
    return level.values(told, views, (0, level.geometry.rows), torch.device("cpu")).numpy()
