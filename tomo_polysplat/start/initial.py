"""The volume that a fit starts from."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import torch

from tomo_polysplat.checks import fail, require_array, require_shape
from tomo_polysplat.ranks import RankFailed
from tomo_polysplat.scan.defects import fill_invalid
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.continued import continuation, continued, few_rows
from tomo_polysplat.start.fdk import fdk, fits_fdk
from tomo_polysplat.start.on_gpu import fdk_on_gpu
from tomo_polysplat.start.sirt import sirt
from tomo_polysplat.start.source_planes import beyond_sources
from tomo_polysplat.start.whole_rows import WholeRows, fill_rows

__all__ = ["initial_volume", "initial_volume_on"]

_log = logging.getLogger(__name__)

# Below this many views filtered backprojection is further from the truth than ten passes of SIRT (spheres in
# 48^3 voxels with 1 % noise: errors of 1.4 and 1.2 % at 40 views, 1.1 and 1.3 % at 60).
FEW_VIEWS = 40
_VIEWS_PER_SUBSET = 6
# Passes of SIRT times views: over ordered subsets the noise grows with the number of updates.
_PASSES_TIMES_VIEWS, _PASSES = 400, (3, 10)
# Voxels, or pixels at the object, that a seed with its three deviations takes up to either side.
_SOURCE_MARGIN = 2.0
# Steps along rays in one pass of SIRT beyond which a coarser volume and detector do for a start: a few
# seconds for all passes on two CPU cores.
_MOST_STEPS = 4e7
# Rays that are counted at once.
_COUNTED = 1 << 26
# Rows of the detector, and slices, that a coarse one keeps at least.
_FEWEST_ROWS = 4


def initial_volume_on(
    projections: torch.Tensor, geometry: Geometry, grid: VolumeGrid, device: torch.device | None = None
) -> tuple[torch.Tensor, dict[str, Any]]:
    """As `initial_volume` for projections on a device, where the volume is, too, if it fits there.

    The device, that of the projections by default, may be a GPU that had no room for them.
    """
    device = projections.device if device is None else device
    volume, reason, where = None, "", device.type
    if where == "cuda":
        fits, reason = _method(geometry, grid)
        try:
            if fits:
                longer = continuation(fill_rows(few_rows(projections)), geometry, grid)
                volume = fdk_on_gpu(WholeRows(projections, longer), longer.geometry, grid, device)
                reason += longer.words
        except RankFailed:
            raise
        except RuntimeError as problem:
            # Torch's, or ASTRA's, whose memory comes on top of torch's.
            _log.warning("The start is made on the CPU: %s", problem)
            where = "cpu"
    if volume is None:
        found, done = initial_volume(projections.cpu().numpy(), geometry, grid, device=where)
        return torch.from_numpy(np.ascontiguousarray(found)).to(projections.device), done
    # In parts: to add up what is true takes 8 bytes a ray.
    invalid = sum(int((~torch.isfinite(part)).sum()) for part in projections.reshape(-1).split(_COUNTED))
    _tell("fdk", reason, invalid, projections.numel())
    beyond, near = _beyond_sources(geometry, grid)
    if beyond is not None:
        volume[torch.from_numpy(beyond.copy()).to(volume.device)] = 0.0
    return volume, {"method": "fdk", "reason": reason + near, "invalid_pixels": invalid}


def _tell(method: str, reason: str, invalid: int, rays: int) -> None:
    left_out = f"; {invalid / rays:.2g} of the rays are left out" if invalid else ""
    _log.debug("A first volume by %s: %s%s.", method.upper(), reason, left_out)


def _method(geometry: Geometry, grid: VolumeGrid) -> tuple[bool, str]:
    """Whether filtered backprojection is the better start, and why (not)."""
    fits, reason = fits_fdk(geometry, grid)
    if fits and geometry.views < FEW_VIEWS:
        return False, f"only {geometry.views} views"
    return fits, reason


def initial_volume(
    projections: np.ndarray,
    geometry: Geometry,
    grid: VolumeGrid,
    *,
    valid: np.ndarray | None = None,
    device: str = "cpu",
) -> tuple[np.ndarray, dict[str, Any]]:
    """Reconstruct quickly: filtered backprojection where it fits and is finite, else a few passes of SIRT.

    Parameters
    ----------
    projections : (views, rows, columns) float32
        ``-log(I / I0)``, water-corrected or not.
    geometry, grid : Geometry, VolumeGrid
        The scan and the voxels.
    valid : (views, rows, columns) bool, optional
        Pixels that may be used; pixels that are not finite never are.
    device : {"cpu", "cuda"}
        Where a GPU may be used.

    Returns
    -------
    volume : (nz, ny, nx) float32
        Attenuation per unit of length.
    info : dict
        ``method`` ("fdk" or "sirt"), ``reason`` and ``invalid_pixels`` (not used, and for FDK interpolated
        from their row). The reason also says how many voxels were left empty because a source plane is near.

    Raises
    ------
    ValueError
        If shapes disagree, no pixel is valid, or the volume does not come out finite by either method.
    """
    projections = require_array("projections", projections, ndim=3)
    require_shape("projections", projections, geometry.shape, "(views, rows, columns)")
    usable = np.isfinite(projections)
    if valid is not None:
        require_shape("valid", np.asarray(valid), geometry.shape, "(views, rows, columns)")
        usable &= valid
    if not usable.any():
        raise ValueError("projections: expected some valid pixels, got none")
    fits, reason = _method(geometry, grid)
    invalid, volume = int((~usable).sum()), None
    if fits:
        # Smooth: the noise of a sharp filter would be seeded as if it were matter.
        filled = torch.from_numpy(np.ascontiguousarray(fill_invalid(projections, usable), dtype=np.float32))
        wide, wider, longer = continued(filled, geometry, grid)
        volume = fdk(wide.numpy(), wider, grid, filter_name="hann", device=device)
        reason += longer
        if not np.isfinite(volume).all():
            fits, reason = False, f"filtered backprojection is not finite ({reason})"
            _log.warning("The start is made by SIRT: %s.", reason)
    method = "fdk" if fits else "sirt"
    _tell(method, reason, invalid, projections.size)
    if volume is None or not fits:
        volume = _finite(_sirt_start(np.where(usable, projections, np.nan), geometry, grid))
    beyond, near = _beyond_sources(geometry, grid)
    if beyond is not None:
        volume = np.where(beyond, np.float32(0), volume)
    return volume, {"method": method, "reason": reason + near, "invalid_pixels": invalid}


def _finite(volume: np.ndarray) -> np.ndarray:
    if not np.isfinite(volume).all():
        remedy = "give -log(I/I0), with NaN for rays that are not to be used"
        raise fail("projections", "values of which a finite start can be made", "NaN or infinity", remedy)
    return volume


def _beyond_sources(geometry: Geometry, grid: VolumeGrid) -> tuple[np.ndarray | None, str]:
    """Voxels that lie beyond the sources, if any, and words that say so."""
    width, height = geometry.pixel_size_at(grid.centre)
    planar = geometry.planar and grid.planar
    finest = max(
        float(grid.voxel_size[: 2 if planar else 3].min()), width if planar else np.sqrt(width * height)
    )
    beyond = beyond_sources(geometry, grid, _SOURCE_MARGIN * finest)
    if beyond is None:
        return None, ""
    _log.warning("%d voxels lie beyond a source or too near to one, and are left empty.", int(beyond.sum()))
    return beyond, f"; {int(beyond.sum())} voxels beyond the sources left empty"


def _sirt_start(projections: np.ndarray, geometry: Geometry, grid: VolumeGrid) -> np.ndarray:
    """SIRT from zero, on a grid and a detector coarse enough to take seconds."""
    from scipy.ndimage import zoom

    views, slices = geometry.views, grid.shape[0]
    factor = 1
    while _steps(geometry, grid, factor) > _MOST_STEPS and 16 * factor <= min(
        geometry.columns, *grid.shape[1:]
    ):
        factor *= 2
    passes = int(np.clip(_PASSES_TIMES_VIEWS // views, *_PASSES))
    factors = np.array([_along_axis(factor, slices), factor, factor])
    counts = -(-np.array(grid.shape) // factors)
    coarse = VolumeGrid(tuple(counts), grid.lower, grid.lower + (counts * factors)[::-1] * grid.voxel_size)
    row_factor = _along_axis(factor, geometry.rows)
    volume = sirt(
        _binned(projections, row_factor, factor),
        geometry.binned(factor, row_factor),
        coarse,
        passes=passes,
        subsets=max(1, views // _VIEWS_PER_SUBSET),
    )
    if factor == 1:
        return volume
    nz, ny, nx = grid.shape
    return zoom(volume, factors, order=1, mode="nearest", grid_mode=True)[:nz, :ny, :nx]


def _along_axis(factor: int, count: int) -> int:
    """By how much rows or slices are made coarser, where columns are by ``factor``: there may be few of them."""
    return min(factor, max(1, count // _FEWEST_ROWS))


def _steps(geometry: Geometry, grid: VolumeGrid, factor: int) -> float:
    """Steps along rays in one pass of SIRT."""
    pixels = float(np.prod(geometry.shape)) / (factor * _along_axis(factor, geometry.rows))
    return pixels * max(grid.shape) / factor


def _binned(projections: np.ndarray, row_factor: int, factor: int) -> np.ndarray:
    """Mean of the finite pixels of each block, NaN where there is none."""
    views, rows, columns = projections.shape
    rows, columns = rows // row_factor, columns // factor
    blocks = projections[:, : rows * row_factor, : columns * factor]
    blocks = blocks.reshape(views, rows, row_factor, columns, factor)
    finite = np.isfinite(blocks)
    count = finite.sum(axis=(2, 4))
    total = np.where(finite, blocks, 0).sum(axis=(2, 4))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)
