"""How much of a faint contrast a result keeps, told by faint balls whose rays are added to the scan."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from tomo_polysplat.checks import require_number
from tomo_polysplat.physics.beer_lambert import projection
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.physics.water import areal_density
from tomo_polysplat.quality.refit import fit_again, geometry_of, levels_of, require_scan_of, voxel_edge
from tomo_polysplat.result.detail import Contrast
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.flattened import flattened
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid, from_astra
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.units import cm_per

__all__ = ["contrast", "ball_in_voxels", "paths_through_balls", "places_for_balls"]

logger = logging.getLogger(__name__)

# Diameters of the balls in voxels, and of how many each there are at most.
_DIAMETERS, _EACH = (2.0, 3.0, 4.0, 6.0), 4
# Voxels between a ball and air, metal or another ball, and how wide the ring around it is that is its background.
_APART, _RING = 2.0, 2.0
# What holds less of the soft reference than this is no place for a ball.
_MATTER = 0.5
# Points a voxel and axis that tell how much of it lies in a ball.
_POINTS = 5


# One parameter for each option that a caller names.
def contrast(
    result: Result,
    scan: Scan,
    *,
    added: float = 0.05,
    diameters: Sequence[float] = _DIAMETERS,
    seed: int = 0,
    device: str = "auto",
    progress: Any = None,
) -> Contrast:
    """Add the rays of faint balls to the scan, fit anew with every decision as it was, and see what is left of them.

    The fit begins anew, with a start of its own, for what a few more passes add to a finished fit is not what that fit
    would have kept. It takes about as long as the result did. No truth is needed.

    Parameters
    ----------
    result : Result
    scan : Scan
        What it was made from.
    added : float
        Contrast of the balls, as a share of the attenuation of the object's main matter.
    diameters : sequence of float
        In voxels.
    seed : int
        Of the places.
    device : {"auto", "cpu", "cuda", "cuda:N"}
    progress : bool or callable, optional
        As in :func:`tomo_polysplat.reconstruct`.

    Raises
    ------
    ValueError
        If the scan has another volume than the result, or for a contrast or diameter that is not above 0.
    """
    added = require_number("added", added, above=0, at_most=1)
    sizes = [require_number("diameters", one, above=0) for one in diameters]
    require_scan_of(result, scan)
    scan = flattened(scan)
    without, voxel = result.volume_zyx, voxel_edge(result.grid)
    radii = 0.5 * voxel * np.array(sizes)
    balls = places_for_balls(without, result, radii, seed)
    kept, error = (np.full(len(sizes), np.nan) for _ in range(2))
    begun = time.perf_counter()
    if balls:
        logger.info("A fit with %d faint balls will take about as long as the result did.", len(balls))
        geometry, _ = from_astra(geometry_of(result, scan), scan.vol_geom)
        level = added * levels_of(result).soft
        rays = with_balls(scan, result, paths_through_balls(geometry, balls), level)
        found = fit_again(result, scan, projections=rays, device=device, progress=progress)
        shares: dict[float, list[float]] = {}
        for centre, radius in balls:
            one = _share_kept(found - without, level, result.grid, centre, radius)
            shares.setdefault(radius, []).append(one)
        for k, radius in enumerate(radii):
            if radius in shares:
                kept[k] = np.mean(shares[radius])
                if len(shares[radius]) > 1:
                    error[k] = np.std(shares[radius], ddof=1) / len(shares[radius]) ** 0.5
    seconds = time.perf_counter() - begun
    return Contrast(2 * radii, kept, error, added, voxel, result.unit, seconds)


def places_for_balls(
    volume: np.ndarray, result: Result, radii: np.ndarray, seed: int
) -> list[tuple[np.ndarray, float]]:
    """Centres (x, y, z) and radii of balls in matter, away from metal, air and each other; the largest first."""
    from scipy import ndimage

    grid, levels = result.grid, levels_of(result)
    edges = grid.voxel_size[::-1]
    matter = (volume > _MATTER * levels.soft) & (volume < 0.5 * levels.metal)
    padded = np.pad(matter, [(int(n > 1), int(n > 1)) for n in matter.shape])
    room = ndimage.distance_transform_edt(padded, sampling=edges)
    room = room[tuple(slice(1, -1) if n > 1 else slice(None) for n in matter.shape)]
    rng, found = np.random.default_rng(seed), []
    for radius in sorted(map(float, radii), reverse=True):
        for _ in range(_EACH):
            free = np.flatnonzero(room > radius + _APART * edges.max())
            if not len(free):
                break
            index = np.unravel_index(int(rng.choice(free)), room.shape)
            centre = grid.lower + (np.array(index[::-1]) + 0.5) * grid.voxel_size
            found.append((centre, radius))
            # The next ones keep their distance, rings and all.
            away = _distance(grid, centre) - radius - (_RING + _APART) * edges.max()
            room = np.minimum(room, away)
    return found


def _distance(grid: VolumeGrid, centre: np.ndarray) -> np.ndarray:
    """(z, y, x) of the voxels' centres from a point, within the slice of a planar grid."""
    squares: np.ndarray | float = 0.0
    for axis in range(3):
        n = grid.shape[2 - axis]
        if n == 1:
            continue
        place = grid.lower[axis] + (np.arange(n) + 0.5) * grid.voxel_size[axis] - centre[axis]
        squares = squares + (place**2).reshape([-1 if k == 2 - axis else 1 for k in range(3)])
    return np.sqrt(np.broadcast_to(squares, grid.shape))


def paths_through_balls(geometry: Geometry, balls: Sequence[tuple[np.ndarray, float]]) -> np.ndarray:
    """(views, rows, columns) length that each ray has in the balls, in the geometry's unit; they do not overlap."""
    centres = np.array([centre for centre, _ in balls])
    places = geometry.project_points(centres)
    width, height = (np.linalg.norm(step, axis=1) for step in (geometry.u, geometry.v))
    paths = np.zeros(geometry.shape, np.float32)
    for k, (centre, radius) in enumerate(balls):
        larger = geometry.magnification(centre)
        for view in range(geometry.views):
            reach = radius * larger[view] / np.array([width[view], height[view]])
            # A slanting detector sees a ball longer than it is.
            spans = [
                slice(max(0, int(p - 2 * r - 2)), min(n, int(p + 2 * r + 3)))
                for p, r, n in zip(places[view, k], reach, (geometry.columns, geometry.rows))
            ]
            columns, rows = spans
            if columns.start < columns.stop and rows.start < rows.stop:
                paths[view, rows, columns] += _chords(geometry, view, rows, columns, centre, radius)
    return paths


def _chords(
    geometry: Geometry, view: int, rows: slice, columns: slice, centre: np.ndarray, radius: float
) -> np.ndarray:
    row = np.arange(rows.start, rows.stop)[:, None, None]
    column = np.arange(columns.start, columns.stop)[None, :, None]
    pixels = geometry.corner[view] + column * geometry.u[view] + row * geometry.v[view]
    if geometry.beam == "parallel":
        towards = np.broadcast_to(geometry.origin[view], pixels.shape)
    else:
        towards = pixels - geometry.origin[view]
    towards = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    off = pixels - centre
    along = np.einsum("rck,rck->rc", off, towards)
    squares = radius**2 - (np.einsum("rck,rck->rc", off, off) - along**2)
    return 2 * np.sqrt(np.maximum(squares, 0.0))


def with_balls(scan: Scan, result: Result, paths: np.ndarray, level: float) -> np.ndarray:
    """(rows, views, columns) the scan's projections with matter of so much attenuation on the way of its rays.

    Under a spectrum it is of the soft material, and hardens the beam as it would behind as much of that as the ray
    shows: metal hardens it a little more.
    """
    values, more = scan.projections, paths.transpose(1, 0, 2)
    if result.materials is None or result.spectrum is None or result.energy_kev is None:
        return (values + level * more).astype(np.float32)
    soft, spectrum = result.materials.soft, result.spectrum
    per_gram = float(mass_attenuation(soft, result.energy_kev))
    density = level / (per_gram * cm_per(result.unit))
    lit = spectrum.weights > 0
    curve = mass_attenuation(soft, spectrum.energies[lit])[None]
    logs = np.log(spectrum.weights[lit] / spectrum.weights.sum())
    rays = values.copy()
    # A few rays at a time: each has a number for every energy.
    for view in range(rays.shape[1]):
        changed = np.isfinite(values[:, view]) & (more[:, view] > 0)
        before = areal_density(values[:, view][changed], spectrum, soft)
        after = before + density * cm_per(result.unit) * more[:, view][changed]
        rise = projection(after[None], logs, curve) - projection(before[None], logs, curve)
        rays[:, view][changed] += rise.astype(np.float32)
    return rays


def ball_in_voxels(grid: VolumeGrid, centre: np.ndarray, radius: float) -> np.ndarray:
    """(z, y, x) share of each voxel that lies in a ball, or in its disc in a planar grid."""
    near = _distance(grid, centre) < radius + grid.voxel_size.max()
    share = np.zeros(grid.shape, np.float32)
    several = np.array([n > 1 for n in grid.shape])[::-1]
    steps = [(np.arange(_POINTS) + 0.5) / _POINTS - 0.5 if many else np.zeros(1) for many in several]
    points = np.stack(np.meshgrid(*steps, indexing="ij"), -1).reshape(-1, 3) * grid.voxel_size
    index = np.argwhere(near)
    middles = grid.lower + (index[:, ::-1] + 0.5) * grid.voxel_size - centre
    away = ((middles[:, None] + points)[..., several] ** 2).sum(axis=-1)
    share[near] = (away <= radius**2).mean(axis=1)
    return share


def _share_kept(
    gained: np.ndarray, level: float, grid: VolumeGrid, centre: np.ndarray, radius: float
) -> float:
    """Contrast of what was gained in a ball against the ring around it, over that of the ball itself."""
    truth = ball_in_voxels(grid, centre, radius)
    away = _distance(grid, centre)
    edge = float(grid.voxel_size.max())
    ring = (away > radius + edge) & (away <= radius + (1 + _RING) * edge)
    inside = truth > 0
    background = float(gained[ring].mean()) if ring.any() else 0.0
    there = float((gained[inside] * truth[inside]).sum() / truth[inside].sum()) - background
    return there / (level * float((truth[inside] ** 2).sum() / truth[inside].sum()))
