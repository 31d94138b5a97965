"""Between ASTRA's geometries and array orders, and ours."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from itertools import permutations
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_choice, require_number
from tomo_polysplat.parallel import contiguous
from tomo_polysplat.scan.angles import require_radians
from tomo_polysplat.scan.curved_detector import flat_geometry, flatten_projections
from tomo_polysplat.scan.view_geometry import Geometry
from tomo_polysplat.scan.volume_grid import VolumeGrid, require_count

__all__ = [
    "from_astra",
    "geometry_from_astra",
    "geometry_to_astra",
    "grid_from_astra",
    "is_planar_geometry",
    "projections_from_astra",
    "require_projections",
    "to_astra",
    "volume_from_astra",
    "volume_to_astra",
]

_log = logging.getLogger(__name__)

_PLANAR_TYPES = ("parallel", "parallel_vec", "fanflat", "fanflat_vec")
_SPATIAL_TYPES = ("parallel3d", "parallel3d_vec", "cone", "cone_vec", "cyl_cone_vec")
_VECTOR_SIZE = {"parallel_vec": 6, "fanflat_vec": 6, "parallel3d_vec": 12, "cone_vec": 12, "cyl_cone_vec": 13}


def is_planar_geometry(geometry: Mapping[str, Any]) -> bool:
    """True if an ASTRA projection or volume geometry is a 2D one."""
    if isinstance(geometry, Mapping) and "GridRowCount" in geometry:
        return "GridSliceCount" not in geometry
    return _type_of(geometry) in _PLANAR_TYPES


def from_astra(proj_geom: Mapping[str, Any], vol_geom: Mapping[str, Any]) -> tuple[Geometry, VolumeGrid]:
    """Translate ASTRA's geometries.

    Parameters
    ----------
    proj_geom : dict
        Any ASTRA projection geometry but ``sparse_matrix``. A curved detector (``cyl_cone_vec``) comes back
        as the flat one that `projections_from_astra` resamples to.
    vol_geom : dict
        ASTRA volume geometry; 2D with a 2D projection geometry. Window options that are absent stand for
        voxels of size 1 around the origin, as in ASTRA.

    Returns
    -------
    Geometry, VolumeGrid
        A 2D scan becomes one detector row and one slice at z = 0.

    Raises
    ------
    ValueError, TypeError
        If something is missing, not finite, in degrees, or does not fit together.
    """
    if _is_volume(proj_geom) and not _is_volume(vol_geom):
        remedy = "the projection geometry comes first"
        raise fail("proj_geom, vol_geom", "geometries in this order", "them exchanged", remedy)
    kind = _type_of(proj_geom)
    if not isinstance(vol_geom, Mapping) or "GridRowCount" not in vol_geom:
        raise fail("vol_geom", "a dict from astra.create_vol_geom", repr(vol_geom), "", TypeError)
    if is_planar_geometry(proj_geom) != is_planar_geometry(vol_geom):
        kinds = [f"a {'2D' if is_planar_geometry(g) else '3D'} one" for g in (proj_geom, vol_geom)]
        remedy = "give create_vol_geom (rows, columns) in 2D or (rows, columns, slices) in 3D"
        raise fail("vol_geom", f"{kinds[0]} to go with proj_geom {kind!r}", kinds[1], remedy)
    grid = grid_from_astra(vol_geom)
    geometry = geometry_from_astra(proj_geom)
    _check_source(geometry, grid)
    _log.debug("%s", geometry.describe())
    return geometry, grid


def geometry_from_astra(proj_geom: Mapping[str, Any]) -> Geometry:
    """Translate ASTRA's projection geometry alone; see `from_astra`."""
    from astra import geom_2vec

    kind = _type_of(proj_geom)
    proj_geom = dict(proj_geom)
    if "Vectors" in proj_geom or kind.endswith("_vec"):
        proj_geom["Vectors"] = _checked_vectors(proj_geom, kind)
    else:
        proj_geom["ProjectionAngles"] = require_radians(
            "ProjectionAngles", _entry(proj_geom, "ProjectionAngles")
        )
        _check_distances(proj_geom)
    vectors = geom_2vec(proj_geom)["Vectors"]
    if kind in _PLANAR_TYPES:
        return _planar_geometry(kind, vectors, _entry(proj_geom, "DetectorCount"))
    rows, columns = _entry(proj_geom, "DetectorRowCount"), _entry(proj_geom, "DetectorColCount")
    return _spatial_geometry(kind, vectors, rows, columns)


def _is_volume(geometry: Any) -> bool:
    return isinstance(geometry, Mapping) and "GridRowCount" in geometry and "type" not in geometry


def to_astra(geometry: Geometry, grid: VolumeGrid) -> tuple[dict[str, Any], dict[str, Any]]:
    """ASTRA's 3D vector geometry and volume geometry for ours; a 2D scan becomes one row and one slice."""
    import astra

    slices, rows, columns = grid.shape
    window = [float(edge) for pair in zip(grid.lower, grid.upper) for edge in pair]
    return geometry_to_astra(geometry), astra.create_vol_geom(rows, columns, slices, *window)


def geometry_to_astra(geometry: Geometry) -> dict[str, Any]:
    """The first of `to_astra`, which needs no volume."""
    import astra

    kind = "cone_vec" if geometry.beam == "cone" else "parallel3d_vec"
    vectors = np.hstack([geometry.origin, geometry.centre, geometry.u, geometry.v])
    return astra.create_proj_geom(kind, geometry.rows, geometry.columns, vectors)


def projections_from_astra(projections: Any, proj_geom: Mapping[str, Any]) -> np.ndarray:
    """Projections in our order.

    Parameters
    ----------
    projections : array
        ``(rows, views, columns)`` for a 3D geometry, ``(views, columns)`` for a 2D one.
    proj_geom : dict
        The ASTRA geometry that they belong to.

    Returns
    -------
    (views, rows, columns) float32, C-contiguous
        Possibly the caller's own memory: not to be written to. Pixels of a flat detector that the curved one
        of ``cyl_cone_vec`` does not cover are NaN.

    Raises
    ------
    ValueError, TypeError
        If the shape is not that of the geometry; the message names the order that was probably given.
    """
    array = require_array("projections", projections)
    require_projections(array, proj_geom)
    if is_planar_geometry(proj_geom):
        return np.ascontiguousarray(array[:, None, :], dtype=np.float32)
    ordered = contiguous(array.swapaxes(0, 1), np.float32)
    if _type_of(proj_geom) != "cyl_cone_vec":
        return ordered
    return flatten_projections(ordered, _checked_vectors(proj_geom, "cyl_cone_vec"))


def require_projections(array: Any, proj_geom: Mapping[str, Any]) -> None:
    """Refuse what has not the shape that a geometry tells; the message names the order that was probably given."""
    views = _number_of_views(proj_geom)
    if is_planar_geometry(proj_geom):
        columns = require_count("DetectorCount", _entry(proj_geom, "DetectorCount"))
        _require_order(array, {"views": views, "columns": columns})
        return
    rows = require_count("DetectorRowCount", _entry(proj_geom, "DetectorRowCount"))
    columns = require_count("DetectorColCount", _entry(proj_geom, "DetectorColCount"))
    _require_order(array, {"rows": rows, "views": views, "columns": columns})


def volume_from_astra(volume: Any, vol_geom: Mapping[str, Any]) -> np.ndarray:
    """A volume ``(z, y, x)`` with y ascending, from ASTRA's ``(z, y, x)`` or 2D image (row 0 at +y)."""
    array = require_array("volume", volume)
    grid = grid_from_astra(vol_geom)
    expected = grid.shape[1:] if is_planar_geometry(vol_geom) else grid.shape
    if array.shape != expected:
        order = "(y, x)" if len(expected) == 2 else "(z, y, x)"
        raise fail("volume", f"shape {expected} {order}", f"{array.shape}")
    return array[None, ::-1, :] if is_planar_geometry(vol_geom) else array


def volume_to_astra(volume: np.ndarray, vol_geom: Mapping[str, Any]) -> np.ndarray:
    """The inverse of `volume_from_astra`."""
    return volume[0, ::-1, :] if is_planar_geometry(vol_geom) else volume


def _type_of(proj_geom: Mapping[str, Any]) -> str:
    if not isinstance(proj_geom, Mapping) or "type" not in proj_geom:
        raise fail(
            "proj_geom", "a dict from astra.create_proj_geom", repr(type(proj_geom).__name__), "", TypeError
        )
    kind = proj_geom["type"]
    matrix = "a matrix has no rays; give the geometry that it was made from"
    remedy = matrix if isinstance(kind, str) and kind == "sparse_matrix" else ""
    return require_choice("proj_geom type", kind, _PLANAR_TYPES + _SPATIAL_TYPES, remedy)


def _entry(geometry: Mapping[str, Any], key: str) -> Any:
    if key not in geometry:
        raise fail(key, "an entry of the ASTRA geometry", "none", "make it with astra.create_proj_geom")
    return geometry[key]


def _number_of_views(proj_geom: Mapping[str, Any]) -> int:
    return len(_entry(proj_geom, "Vectors" if _type_of(proj_geom).endswith("_vec") else "ProjectionAngles"))


def grid_from_astra(vol_geom: Mapping[str, Any]) -> VolumeGrid:
    """The volume of ASTRA's geometry of one; without a window its voxels have edges of 1."""
    names = {"X": "GridColCount", "Y": "GridRowCount", "Z": "GridSliceCount"}
    planar = is_planar_geometry(vol_geom)
    counts, lower, upper = [], [], []
    options = vol_geom.get("option", vol_geom.get("options", {}))
    for axis in "XY" if planar else "XYZ":
        count = require_count(names[axis], _entry(vol_geom, names[axis]))
        counts.append(count)
        lower.append(require_number(f"WindowMin{axis}", options.get(f"WindowMin{axis}", -0.5 * count)))
        upper.append(require_number(f"WindowMax{axis}", options.get(f"WindowMax{axis}", 0.5 * count)))
    if planar:
        # A slice has no thickness; one voxel wide keeps its only voxel a cube for square pixels.
        half = 0.5 * abs(upper[0] - lower[0]) / counts[0]
        counts, lower, upper = [*counts, 1], [*lower, -half], [*upper, half]
    return VolumeGrid((counts[2], counts[1], counts[0]), np.array(lower), np.array(upper))


def _checked_vectors(proj_geom: Mapping[str, Any], kind: str) -> np.ndarray:
    vectors = require_array("Vectors", _entry(proj_geom, "Vectors"), ndim=2).astype(np.float64)
    if vectors.shape[1] != _VECTOR_SIZE[kind]:
        raise fail("Vectors", f"shape (views, {_VECTOR_SIZE[kind]}) for {kind!r}", f"{vectors.shape}")
    bad = ~np.isfinite(vectors).all(axis=1)
    if bad.any():
        raise fail(
            "Vectors", "finite numbers", f"NaN or infinity in {bad.sum()} views, first {np.argmax(bad)}"
        )
    return vectors


def _check_distances(proj_geom: Mapping[str, Any]) -> None:
    kind = _type_of(proj_geom)
    planar = kind in _PLANAR_TYPES
    for key in ("DetectorWidth",) if planar else ("DetectorSpacingX", "DetectorSpacingY"):
        require_number(key, _entry(proj_geom, key), above=0.0)
    for key in ("DetectorCount",) if planar else ("DetectorRowCount", "DetectorColCount"):
        require_count(key, _entry(proj_geom, key))
    if kind in ("cone", "fanflat"):
        require_number("DistanceOriginSource", _entry(proj_geom, "DistanceOriginSource"), above=0.0)
        require_number("DistanceOriginDetector", _entry(proj_geom, "DistanceOriginDetector"), at_least=0.0)


def _planar_geometry(kind: str, vectors: np.ndarray, columns: Any) -> Geometry:
    columns = require_count("DetectorCount", columns)
    origin, centre, u = (np.pad(part, ((0, 0), (0, 1))) for part in np.split(vectors, 3, axis=1))
    v = np.zeros_like(u)
    v[:, 2] = np.linalg.norm(u, axis=1)
    beam = "cone" if kind.startswith("fanflat") else "parallel"
    return Geometry(beam, origin, centre - 0.5 * (columns - 1) * u, u, v, 1, columns)


def _spatial_geometry(kind: str, vectors: np.ndarray, rows: Any, columns: Any) -> Geometry:
    rows, columns = require_count("DetectorRowCount", rows), require_count("DetectorColCount", columns)
    if kind == "cyl_cone_vec":
        return flat_geometry(vectors, rows, columns)
    origin, centre, u, v = np.split(vectors, 4, axis=1)
    corner = centre - 0.5 * (columns - 1) * u - 0.5 * (rows - 1) * v
    beam = "cone" if kind.startswith("cone") else "parallel"
    return Geometry(beam, origin, corner, u, v, rows, columns)


def _check_source(geometry: Geometry, grid: VolumeGrid) -> None:
    """Refuse a source within the object, whose rays would start inside it.

    The object is taken to fill the elliptic cylinder inscribed in the window; corners of the box may well
    reach beyond the orbit.
    """
    if geometry.beam == "parallel":
        return
    offset = np.abs(geometry.origin - grid.centre) / (0.5 * grid.extent)
    inside = (np.hypot(offset[:, 0], offset[:, 1]) < 1.0) & (offset[:, 2] < 1.0)
    if inside.any():
        raise fail(
            "source positions",
            "all outside the volume",
            f"{inside.sum()} of {geometry.views} inside its window, first in view {np.argmax(inside)}",
            "give distances and the window of vol_geom in the same unit; without a window voxels have size 1",
        )
    reached = (offset < 1.0).all(axis=1)
    if reached.any():
        _log.warning("The source lies in a corner of the volume window in %d views.", int(reached.sum()))


def _require_order(array: Any, axes: dict[str, int]) -> None:
    """Refuse a wrong shape, naming the order of axes that would explain it."""
    shape = tuple(axes.values())
    if array.shape == shape:
        return
    names = tuple(axes)
    remedy = ""
    for order in permutations(range(len(names))):
        if array.ndim == len(names) and tuple(shape[k] for k in order) == array.shape:
            given = ", ".join(names[k] for k in order)
            back = tuple(order.index(k) for k in range(len(names)))
            swap = "numpy.swapaxes(projections, 0, 1)"
            turn = swap if back in ((1, 0), (1, 0, 2)) else f"numpy.transpose(projections, {back})"
            remedy = f"the axes look like ({given}) where ASTRA wants ({', '.join(names)}): use {turn}"
            break
    raise fail("projections", f"shape {shape} ({', '.join(names)})", f"{array.shape}", remedy)
