"""A curved detector resampled to a flat one.

ASTRA's ``cyl_cone_vec`` detector is a part of a cylinder: ``u`` is tangent to it at its middle and is the
length of arc of a pixel, ``v`` runs along its axis, and the axis lies on the source's side at the given
radius. The flat detector touches it in the middle and keeps the size of its pixels there.
"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.scan.view_geometry import Geometry

__all__ = ["flat_geometry", "flatten_projections"]


def flat_geometry(vectors: np.ndarray, rows: int, columns: int) -> Geometry:
    """The flat detector, as wide as the shadow of the curved one.

    Parameters
    ----------
    vectors : (views, 13) float64
        ASTRA's ``cyl_cone_vec`` rows: source, middle of the panel, u, v, radius.
    rows, columns : int
        Size of the curved detector. The flat one has as many rows and as many or more columns.
    """
    source, middle, u, v = np.split(vectors[:, :12], 4, axis=1)
    radius = vectors[:, 12]
    width = np.linalg.norm(u, axis=1)
    half_angle = 0.5 * (columns - 1) * width / radius
    if not ((radius > 0).all() and (half_angle < 0.5 * np.pi).all()):
        raise fail("Vectors", "a radius > 0 and a detector of less than half a turn", f"{radius.min():g}")
    edge = _source_in_panel(source, middle, u, v)
    reach = []
    for side in (-1.0, 1.0):
        across, towards = side * radius * np.sin(half_angle), radius * (1.0 - np.cos(half_angle))
        reach.append(edge[:, 0] + (across - edge[:, 0]) * edge[:, 2] / (edge[:, 2] - towards))
    half_columns = int(np.floor(np.max(np.abs(reach) / width)))
    flat_columns = 2 * half_columns + columns % 2
    corner = middle - 0.5 * (flat_columns - 1) * u - 0.5 * (rows - 1) * v
    return Geometry("cone", source, corner, u, v, rows, flat_columns)


def flatten_projections(projections: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Resample projections of a curved detector to `flat_geometry`, bilinearly.

    The error is that of linear interpolation, an eighth of the second difference between neighbouring pixels
    at most; it is zero where the projection is a linear function of the pixel.

    Parameters
    ----------
    projections : (views, rows, columns) float32
        On the curved detector.
    vectors : (views, 13) float64
        ASTRA's ``cyl_cone_vec`` rows.

    Returns
    -------
    (views, rows, flat columns) float32
        NaN where the curved detector has no pixel to interpolate from.
    """
    from scipy.ndimage import map_coordinates

    _, rows, columns = projections.shape
    flat = flat_geometry(vectors, rows, columns)
    result = np.empty(flat.shape, np.float32)
    for view in range(flat.views):
        position = _curved_position(flat, vectors[view], view, rows, columns)
        result[view] = map_coordinates(projections[view], position, order=1, mode="constant", cval=np.nan)
    return result


def _source_in_panel(source: np.ndarray, middle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The source in the panel's frame: across, along the axis, and distance in front, (views, 3)."""
    across = u / np.linalg.norm(u, axis=1, keepdims=True)
    along = v / np.linalg.norm(v, axis=1, keepdims=True)
    if (np.abs(np.einsum("vk,vk->v", across, along)) > 1e-6).any():
        raise fail("Vectors", "u perpendicular to v on a curved detector", "skewed pixels")
    local = np.stack(
        [np.einsum("vk,vk->v", source - middle, a) for a in (across, along, np.cross(across, along))], 1
    )
    local[:, 2] = np.abs(local[:, 2])
    return local


def _curved_position(flat: Geometry, vector: np.ndarray, view: int, rows: int, columns: int) -> np.ndarray:
    """Row and column on the curved detector of the rays to all flat pixels, (2, rows, flat columns)."""
    source, middle, u, v = (part[None] for part in np.split(vector[:12], 4))
    radius, width, height = vector[12], np.linalg.norm(u), np.linalg.norm(v)
    across0, along0, depth0 = _source_in_panel(source, middle, u, v)[0]
    across = (np.arange(flat.columns) - 0.5 * (flat.columns - 1)) * width
    along = (np.arange(rows) - 0.5 * (rows - 1)) * height
    # Ray (across0, depth0) + t (across - across0, -depth0) leaves the circle about (0, radius).
    a = (across - across0) ** 2 + depth0**2
    b = across0 * (across - across0) - (depth0 - radius) * depth0
    c = across0**2 + (depth0 - radius) ** 2 - radius**2
    t = (-b + np.sqrt(b * b - a * c)) / a
    angle = np.arctan2(across0 + t * (across - across0), radius - depth0 + t * depth0)
    column = np.broadcast_to(angle * radius / width + 0.5 * (columns - 1), (rows, flat.columns))
    row = (along0 + t[None, :] * (along[:, None] - along0)) / height + 0.5 * (rows - 1)
    # Rounding must not push the outermost pixels off the panel.
    return np.stack([_snap(row, rows), _snap(column, columns)])


def _snap(position: np.ndarray, count: int) -> np.ndarray:
    nearest = np.clip(position, 0, count - 1)
    return np.where(np.abs(position - nearest) < 1e-6, nearest, position)
