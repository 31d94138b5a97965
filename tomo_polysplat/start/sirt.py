"""SIRT, plain or over ordered subsets of the views."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tomo_polysplat.checks import require_array, require_number, require_shape
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.scan.volume_grid import require_count
from tomo_polysplat.start.joseph import JosephProjector

__all__ = ["sirt"]


# One parameter for each option that a caller names.
def sirt(
    projections: np.ndarray,
    geometry: Geometry,
    grid: VolumeGrid,
    *,
    passes: int = 10,
    subsets: int = 1,
    valid: np.ndarray | None = None,
    initial: np.ndarray | None = None,
    relaxation: float = 1.0,
    nonnegative: bool = True,
    callback: Callable[[int, float, np.ndarray], bool | None] | None = None,
) -> np.ndarray:
    """Simultaneous iterative reconstruction, for any geometry.

    .. math:: x \\leftarrow x + \\lambda C A^T R (p - A x), \\quad R = 1 / (A 1), \\quad C = 1 / (A^T 1)

    Parameters
    ----------
    projections : (views, rows, columns) float32
        ``-log(I / I0)``.
    geometry, grid : Geometry, VolumeGrid
        The scan and the voxels.
    passes : int
        Times that every view is used.
    subsets : int
        Groups of interleaved views, each followed by an update: about as many times faster per pass, at the
        price of more noise in the end. 1 is SIRT itself.
    valid : (views, rows, columns) bool, optional
        Pixels to use; None means those that are finite.
    initial : (nz, ny, nx), optional
        Where to start; None means zero.
    relaxation : float
        Lambda, above 0 and below 2.
    nonnegative : bool
        Whether negative attenuation is set to zero after every update.
    callback : function, optional
        Called after every pass with its number, the root mean square residual of the pass (each subset's
        before its own update) and the volume; True ends the run.

    Returns
    -------
    (nz, ny, nx) float32
        Attenuation per unit of length; voxels that no ray crosses keep their initial value.
    """
    projections = require_array("projections", projections, ndim=3)
    require_shape("projections", projections, geometry.shape, "(views, rows, columns)")
    require_number("relaxation", relaxation, above=0.0, at_most=2.0)
    passes, subsets = require_count("passes", passes), min(require_count("subsets", subsets), geometry.views)
    projector = JosephProjector(geometry, grid)
    usable = np.isfinite(projections) if valid is None else valid & np.isfinite(projections)
    data = np.where(usable, projections, 0).astype(np.float32)
    row_weights, column_weights = _weights(projector, usable)
    column_weights *= np.float32(relaxation * subsets)
    volume = np.zeros(grid.shape, np.float32) if initial is None else np.array(initial, dtype=np.float32)
    require_shape("initial", volume, grid.shape, "(nz, ny, nx)")
    groups = [np.arange(start, geometry.views, subsets) for start in _spread_order(subsets)]
    for number in range(passes):
        square = 0.0
        for views in groups:
            residual = np.where(usable[views], data[views] - projector.forward(volume, views), 0)
            square += float(np.sum(residual.astype(np.float64) ** 2))
            volume += column_weights * projector.adjoint(residual * row_weights[views], views)
            if nonnegative:
                np.maximum(volume, 0, out=volume)
        error = np.sqrt(square / max(int(usable.sum()), 1))
        if callback is not None and callback(number, error, volume):
            break
    return volume


def _weights(projector: JosephProjector, usable: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R and C of SIRT, zero for pixels and voxels that meet no ray."""
    path = projector.forward(np.ones(projector.grid.shape, np.float32))
    # A ray that only grazes the volume would be divided by next to nothing.
    shortest = 0.5 * float(projector.grid.voxel_size.min())
    row_weights = np.where(usable & (path > 0), 1 / np.maximum(path, shortest), 0).astype(np.float32)
    crossed = projector.adjoint(usable.astype(np.float32))
    least = 1e-3 * float(crossed.max(initial=0.0))
    return row_weights, np.where(crossed > least, 1 / np.maximum(crossed, max(least, 1e-30)), 0).astype(
        np.float32
    )


def _spread_order(count: int) -> list[int]:
    """Numbers below ``count`` so that successive ones lie far apart."""
    step = max(1, round(count * 0.618))
    while np.gcd(step, count) != 1:
        step += 1
    return [step * k % count for k in range(count)]
