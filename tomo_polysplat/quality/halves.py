"""Resolution of a result, told by two fits of half the views each."""

from __future__ import annotations

import logging
import time
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.quality.fourier_shell import HALVES, first_below, shell_correlation
from tomo_polysplat.quality.refit import fit_again, levels_of, require_scan_of, voxel_edge
from tomo_polysplat.result.detail import Resolution
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.start.agreement import places_of_views

__all__ = ["resolution", "weight_of"]

logger = logging.getLogger(__name__)

# Views of a half at least.
_FEWEST_VIEWS = 10
# Voxels from metal that do not count, standard deviation of the weight's soft edge, and of the map, in voxels.
_BESIDE_METAL, _SOFT_EDGE, _MAP = 2, 1.5, 2.0
# Voxels along an edge of the middle part that is compared, of a larger volume.
_LONGEST = 512


def resolution(result: Result, scan: Scan, *, device: str = "auto", progress: Any = None) -> Resolution:
    """Fit two halves of the views as the result was fitted, and see down to which fineness they agree.

    Neighbouring views go to different halves, views from one place to the same one. Each half makes as many passes
    over its views as the whole, so that both together take about as long as the result did. No truth is needed, and
    none is known: what both halves have wrong in the same way, such as blur or shadows of metal, they agree on.

    Parameters
    ----------
    result : Result
    scan : Scan
        What it was made from.
    device : {"auto", "cpu", "cuda", "cuda:N"}
    progress : bool or callable, optional
        As in :func:`tomo_polysplat.reconstruct`, twice.

    Raises
    ------
    ValueError
        If the scan has another volume than the result, or too few views.
    """
    require_scan_of(result, scan)
    geometry, _ = from_astra(scan.proj_geom, scan.vol_geom)
    places = places_of_views(geometry)
    halves = [np.flatnonzero(places % 2 == half) for half in (0, 1)]
    if min(map(len, halves)) < _FEWEST_VIEWS:
        got = f"{len(halves[0])} and {len(halves[1])} of {geometry.views} views"
        raise fail("scan", f"at least {_FEWEST_VIEWS} views from other places in each half", got)
    begun = time.perf_counter()
    words = "Two fits of half the views each will take about as long as the result did, %.0f s."
    logger.info(words, result.seconds)
    volumes = [fit_again(result, scan, views=views, device=device, progress=progress) for views in halves]
    return compared(result, volumes, time.perf_counter() - begun)


def compared(result: Result, volumes: list[np.ndarray], seconds: float) -> Resolution:
    """What two volumes of half the views each, (z, y, x), tell of the result of all of them."""
    from scipy import ndimage

    voxel = voxel_edge(result.grid)
    ceiling = levels_of(result).metal
    clipped = [np.minimum(volume, ceiling) for volume in volumes]
    middle = tuple(slice(max(0, (n - _LONGEST) // 2), (n + _LONGEST) // 2) for n in result.grid.shape)
    weight = weight_of(np.maximum(*clipped), result)[middle]
    one, other = (part[middle] for part in clipped)
    curve = shell_correlation(one, other, result.grid.voxel_size, weight)
    found = first_below(curve, HALVES)
    finest = 2 * voxel
    period = finest if found is None else max(1 / found, finest)
    # Half of the difference has the deviation of the mean of both.
    squares = ((volumes[0] - volumes[1]) / 2) ** 2
    doubt = np.sqrt(ndimage.gaussian_filter(squares, [_MAP if n > 1 else 0 for n in squares.shape]))
    unit = result.unit
    return Resolution(period, found is None, voxel, unit, curve, doubt.astype(np.float32), seconds)


def weight_of(volume: np.ndarray, result: Result) -> np.ndarray:
    """(z, y, x) weight with soft edges: 1 in the middle of the volume, 0 beside metal and at the faces."""
    from scipy import ndimage

    several = [n > 1 for n in volume.shape]
    metal = volume >= levels_of(result).metal
    inside = np.ones(volume.shape, bool)
    if metal.any():
        inside &= ~ndimage.binary_dilation(metal, iterations=_BESIDE_METAL)
    for axis in np.flatnonzero(several):
        edge = [slice(None)] * 3
        for end in (slice(0, 2), slice(-2, None)):
            edge[axis] = end
            inside[tuple(edge)] = False
    return ndimage.gaussian_filter(
        inside.astype(np.float32), [_SOFT_EDGE * one for one in several], mode="constant"
    )
