"""ASTRA geometries for what files hold: vectors and windows."""

from __future__ import annotations

from typing import Any

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_choice, require_shape
from tomo_polysplat.scan.geometry import grid_from_astra

__all__ = [
    "spatial_geometry",
    "vector_form",
    "vector_geometry",
    "volume_geometry",
    "window_of",
]

VECTOR_LENGTHS = {"cone_vec": 12, "parallel3d_vec": 12, "cyl_cone_vec": 13}
SPATIAL_TYPES = ("parallel3d", "parallel3d_vec", "cone", "cone_vec", "cyl_cone_vec")


def vector_geometry(kind: str, vectors: np.ndarray, shape: tuple[int, int, int]) -> dict[str, Any]:
    """ASTRA projection geometry of `kind` for a detector of `shape` (rows, views, columns)."""
    import astra

    require_choice("astra_type", kind, VECTOR_LENGTHS)
    vectors = require_array("vectors", vectors, 2).astype(np.float64)
    require_shape("vectors", vectors, (shape[1], VECTOR_LENGTHS[kind]), f"(views, values of a {kind})")
    if not np.isfinite(vectors).all():
        raise fail("vectors", "finite values", "NaN or infinity")
    return astra.create_proj_geom(kind, shape[0], shape[2], vectors)


def volume_geometry(shape: np.ndarray, window: np.ndarray) -> dict[str, Any]:
    """ASTRA volume geometry of `shape` (nz, ny, nx) in `window` (xmin, xmax, ymin, ymax, zmin, zmax)."""
    import astra

    shape, window = require_array("volume shape", shape, 1), require_array("volume window", window, 1)
    require_shape("volume shape", shape, (3,), "(nz, ny, nx)")
    require_shape("volume window", window, (6,), "(xmin, xmax, ymin, ymax, zmin, zmax)")
    counts = np.isfinite(shape).all() and np.all((shape >= 1) & (shape == np.floor(shape)))
    if not (counts and np.isfinite(window).all() and np.all(window[1::2] > window[::2])):
        raise fail("volume", "positive counts and a window with minimum < maximum", f"{shape} in {window}")
    nz, ny, nx = (int(n) for n in shape)
    return astra.create_vol_geom(ny, nx, nz, *(float(w) for w in window))


def vector_form(proj_geom: dict[str, Any]) -> dict[str, Any]:
    """The same geometry with one vector per view, which is what files store."""
    import astra

    spatial_geometry(proj_geom)
    return proj_geom if "Vectors" in proj_geom else astra.geom_2vec(proj_geom)


def spatial_geometry(proj_geom: dict[str, Any]) -> dict[str, Any]:
    """The geometry itself, refused when it is one of ASTRA's two-dimensional types."""
    remedy = "a scan of one plane is a three-dimensional geometry with one detector row"
    require_choice("proj_geom['type']", proj_geom.get("type"), SPATIAL_TYPES, remedy)
    return proj_geom


def window_of(vol_geom: dict[str, Any]) -> np.ndarray:
    """Window (xmin, xmax, ymin, ymax, zmin, zmax) of an ASTRA volume geometry."""
    grid = grid_from_astra(vol_geom)
    return np.stack([grid.lower, grid.upper], axis=1).reshape(-1)
