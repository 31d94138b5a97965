"""Circular scans from what a user knows of them: distances, pixel, angles; and the volume that they see."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_number
from tomo_polysplat.scan.angles import require_radians
from tomo_polysplat.scan.astra_geometry import geometry_from_astra
from tomo_polysplat.scan.layout import volume_geometry
from tomo_polysplat.scan.view_geometry import Geometry
from tomo_polysplat.scan.volume_grid import require_count

__all__ = ["cone_geometry", "parallel_geometry", "volume_seen"]

logger = logging.getLogger(__name__)

# Along an axis; more is a pixel of a size that no detector has.
_MOST_VOXELS = 1 << 31


# One parameter for each option that a caller names.
def cone_geometry(
    *,
    source_object: float,
    source_detector: float,
    pixel: float | tuple[float, float],
    detector: tuple[int, int],
    degrees: Any = None,
    radians: Any = None,
    offset: tuple[float, float] = (0.0, 0.0),
    voxels: int | tuple[int, int, int] | None = None,
    voxel: float | None = None,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """ASTRA's geometries of a circular cone-beam scan about z, all lengths in one unit.

    Parameters
    ----------
    source_object, source_detector : float
        Distances of the source from the rotation axis and from the detector's plane.
    pixel : float, or two
        Side of a pixel on the detector; width and height where they differ.
    detector : (rows, columns)
        Pixels.
    degrees, radians : array, shape (views,)
        One of the two: angles of the source about z, counterclockwise seen from +z, from -y on; an object that turns
        clockwise is the same. Angles of the other sense are negative.
    offset : (u, v)
        Where the detector's middle is from the foot of the ray through the axis: along its columns (+u: to the right
        for one who looks from the source, z up) and along its rows (+v: up).
    voxels : int, or (nz, ny, nx), optional
        Voxels of the volume, cubic for one number. None fills what the detector sees: as many across as columns.
    voxel : float, optional
        Edge of the cubic voxels; None brings the pixel's width down to the axis, ``pixel * source_object /
        source_detector``.

    Returns
    -------
    proj_geom, vol_geom : dict
        For `tomo_polysplat.reconstruct`, with projections (rows, views, columns) whose rows ascend with z: a
        picture's lowest row is the first. The volume lies about the axis at the height that the detector sees.

    Raises
    ------
    ValueError, TypeError
        For numbers that do not fit together.
    """
    import astra

    source_object = require_number("source_object", source_object, above=0.0)
    remedy = "it is measured from the source, and includes source_object"
    source_detector = require_number("source_detector", source_detector, above=0.0, remedy=remedy)
    if source_detector < source_object:
        got = f"{source_detector:g}"
        raise fail("source_detector", f"at least source_object, {source_object:g}", got, remedy)
    (width, height), (rows, columns) = _pixel(pixel), _detector(detector)
    angles = _angles(degrees, radians)
    distances = (source_object, source_detector - source_object)
    straight = astra.create_proj_geom("cone", width, height, rows, columns, angles, *distances)
    return _with_volume(straight, offset, (width, height), voxels, voxel)


# One parameter for each option that a caller names.
def parallel_geometry(
    *,
    pixel: float | tuple[float, float],
    detector: tuple[int, int],
    degrees: Any = None,
    radians: Any = None,
    offset: tuple[float, float] = (0.0, 0.0),
    voxels: int | tuple[int, int, int] | None = None,
    voxel: float | None = None,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """ASTRA's geometries of a parallel-beam scan about z, all lengths in one unit.

    Parameters
    ----------
    pixel, detector, degrees, radians, offset, voxels, voxel
        See `cone_geometry`; `offset` is from the axis' shadow, so that ``u = (columns / 2 - centre) * pixel`` for an
        axis at TomoPy's ``centre``.

    Returns
    -------
    proj_geom, vol_geom : dict
    """
    import astra

    (width, height), (rows, columns) = _pixel(pixel), _detector(detector)
    angles = _angles(degrees, radians)
    straight = astra.create_proj_geom("parallel3d", width, height, rows, columns, angles)
    return _with_volume(straight, offset, (width, height), voxels, voxel)


def volume_seen(
    geometry: Geometry, voxels: int | tuple[int, int, int] | None = None, voxel: float | None = None
) -> dict[str, Any]:
    """ASTRA's volume geometry of what a detector sees about the z axis; see `cone_geometry` for the arguments."""
    width, height = geometry.pixel_size_at(np.zeros(3))
    name, value = ("pixel", width) if voxel is None else ("voxel", voxel)
    size = require_number(name, value, above=0.0)
    shape = _voxels(voxels)
    if shape is None:
        seen = (n * step / size for n, step in ((geometry.columns, width), (geometry.rows, height)))
        across, high = (max(1, round(require_number(name, n, at_most=_MOST_VOXELS))) for n in seen)
        shape = (high, across, across)
    half = 0.5 * size * np.array(shape[::-1])
    middle = np.array([0.0, 0.0, _height_seen(geometry)])
    return volume_geometry(np.array(shape), np.stack([middle - half, middle + half], axis=1).reshape(-1))


def _voxels(voxels: Any) -> tuple[int, int, int] | None:
    if voxels is None:
        return None
    three = [voxels] * 3 if np.ndim(voxels) == 0 else _numbers("voxels", voxels, "(nz, ny, nx)")
    nz, ny, nx = (require_count("voxels", n) for n in three)
    return nz, ny, nx


def _height_seen(geometry: Geometry) -> float:
    """The z of the axis that the detector's middle sees, median over the views."""
    if geometry.beam == "cone":
        brought = (geometry.centre - geometry.origin) / geometry.magnification(np.zeros(3))[:, None]
        return float(np.median((geometry.origin + brought)[:, 2]))
    along = geometry.origin / np.linalg.norm(geometry.origin, axis=1, keepdims=True)
    nearest = geometry.centre - np.einsum("vk,vk->v", geometry.centre, along)[:, None] * along
    return float(np.median(nearest[:, 2]))


def _with_volume(
    straight: dict[str, Any],
    offset: Any,
    pixel: tuple[float, float],
    voxels: int | tuple[int, int, int] | None,
    voxel: float | None,
) -> tuple[dict[str, Any], dict[str, Any]]:
    import astra

    u, v = (require_number("offset", n) for n in _numbers("offset", offset, "(u, v)"))
    if u or v:
        straight = astra.geom_postalignment(straight, (u / pixel[0], v / pixel[1]))
    return straight, volume_seen(geometry_from_astra(straight), voxels, voxel)


def _pixel(pixel: Any) -> tuple[float, float]:
    sides = [pixel, pixel] if np.ndim(pixel) == 0 else _numbers("pixel", pixel, "(width, height)")
    width, height = (require_number("pixel", side, above=0.0) for side in sides)
    return width, height


def _detector(detector: Any) -> tuple[int, int]:
    rows, columns = (require_count("detector", n) for n in _numbers("detector", detector, "(rows, columns)"))
    return rows, columns


def _numbers(argument: str, values: Any, meaning: str) -> Sequence[Any]:
    """As many numbers as `meaning` names."""
    wanted = meaning.count(",") + 1
    array = require_array(argument, values)
    if array.shape != (wanted,):
        raise fail(argument, f"{wanted} numbers {meaning}", repr(values))
    return array.tolist()


def _angles(degrees: Any, radians: Any) -> np.ndarray:
    if (degrees is None) == (radians is None):
        got = "neither" if degrees is None else "both"
        raise fail("degrees, radians", "the angles of all views in one of the two", got)
    if radians is not None:
        return require_radians("radians", radians)
    values = require_array("degrees", degrees, 1).astype(np.float64)
    if not (values.size and np.isfinite(values).all()):
        raise fail("degrees", "finite angles", "none" if not values.size else "NaN or infinity")
    if len(values) > 2 and np.ptp(values) < 2 * math.pi + 0.1:
        logger.warning("degrees span %.3g only: are these radians? Pass radians= then.", np.ptp(values))
    return np.deg2rad(values)
