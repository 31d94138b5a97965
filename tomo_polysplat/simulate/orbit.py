"""Circular scans as ASTRA geometries, and the rays of their views.

The dictionaries are written out here rather than asked of ASTRA, and the rays are computed here rather than
by the reconstruction's geometry: the simulator stays an independent witness of both. Directions follow ASTRA:
at angle t the source of a cone lies at ``(sin t, -cos t, 0)`` times its distance, columns run along ``(cos t,
sin t, 0)`` and rows along +z.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tomo_polysplat.checks import require_choice

__all__ = ["ORBITS", "circular_orbit", "view_vectors"]

ORBITS = ("cone", "parallel", "fan")

# In half widths of the volume: an object that fills it spans +-11 degrees and is magnified 1.5 times, as on a
# bench-top scanner.
SOURCE_DISTANCE = 5.0
DETECTOR_DISTANCE = 2.5
# The detector is square and just as wide as the shadow of the volume's vertical edges, which is higher than
# the volume's own. Every voxel is then seen in every view, and filtered backprojection has no rim of its own
# making.
CORNER = math.sqrt(2.0)
CONE_SIDE = 2.0 * (SOURCE_DISTANCE + DETECTOR_DISTANCE) * CORNER / math.sqrt(SOURCE_DISTANCE**2 - CORNER**2)
PARALLEL_SIDE = 2.0 * CORNER


def circular_orbit(
    kind: str, half_width: float, size: int, rows: int, columns: int, angles: np.ndarray
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Projection and volume geometry of a circular scan about z.

    Parameters
    ----------
    kind : "cone", "parallel" or "fan"
        A fan is a cone beam with one detector row and one slice, both in the plane z = 0.
    half_width : float
        Half the edge of the cubic volume, in cm.
    size : int
        Voxels per edge.
    rows, columns : int
        Pixels of the detector, whose size does not depend on them; ``rows`` is ignored for a fan.
    angles : (views,)
        In radians.

    Returns
    -------
    proj_geom, vol_geom : dict
        As ``astra.create_proj_geom`` and ``astra.create_vol_geom`` make them, in cm.
    """
    require_choice("geometry", kind, ORBITS)
    half = float(half_width)
    voxel = 2.0 * half / size
    slices = 1 if kind == "fan" else size
    vol_geom = {
        "GridRowCount": size,
        "GridColCount": size,
        "GridSliceCount": slices,
        "option": {
            "WindowMinX": -half,
            "WindowMaxX": half,
            "WindowMinY": -half,
            "WindowMaxY": half,
            "WindowMinZ": -voxel * slices / 2,
            "WindowMaxZ": voxel * slices / 2,
        },
    }
    side = half * (PARALLEL_SIDE if kind == "parallel" else CONE_SIDE)
    if kind == "fan":
        return _fan(half, side / columns, columns, angles), vol_geom
    proj_geom = {
        "type": "cone" if kind == "cone" else "parallel3d",
        "DetectorSpacingX": side / columns,
        "DetectorSpacingY": side / rows,
        "DetectorRowCount": rows,
        "DetectorColCount": columns,
        "ProjectionAngles": np.asarray(angles, float),
    }
    if kind == "cone":
        proj_geom["DistanceOriginSource"] = SOURCE_DISTANCE * half
        proj_geom["DistanceOriginDetector"] = DETECTOR_DISTANCE * half
    return proj_geom, vol_geom


def _fan(half: float, pixel: float, columns: int, angles: np.ndarray) -> dict[str, Any]:
    along, across, up = _directions(angles)
    vectors = np.hstack(
        [SOURCE_DISTANCE * half * along, -DETECTOR_DISTANCE * half * along, pixel * across, pixel * up]
    )
    return {"type": "cone_vec", "DetectorRowCount": 1, "DetectorColCount": columns, "Vectors": vectors}


def _directions(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors (views, 3) towards the source, along the columns and along the rows."""
    sine, cosine = np.sin(angles), np.cos(angles)
    zero, one = np.zeros_like(sine), np.ones_like(sine)
    return (
        np.stack([sine, -cosine, zero], axis=1),
        np.stack([cosine, sine, zero], axis=1),
        np.stack([zero, zero, one], axis=1),
    )


def view_vectors(proj_geom: dict[str, Any]) -> tuple[bool, np.ndarray]:
    """Where the rays of each view run.

    Parameters
    ----------
    proj_geom : dict
        Of type cone, cone_vec, parallel3d or parallel3d_vec.

    Returns
    -------
    cone : bool
    vectors : (views, 4, 3) float64
        Source of the cone, or direction of the parallel beam; centre of pixel (0, 0); step to the next
        column; step to the next row. In cm.
    """
    kind = require_choice(
        "proj_geom type", proj_geom["type"], ("cone", "cone_vec", "parallel3d", "parallel3d_vec")
    )
    cone = kind.startswith("cone")
    if kind.endswith("_vec"):
        vectors = np.array(proj_geom["Vectors"], float).reshape(-1, 4, 3)
    else:
        along, across, up = _directions(np.asarray(proj_geom["ProjectionAngles"], float))
        columns, rows = proj_geom["DetectorSpacingX"] * across, proj_geom["DetectorSpacingY"] * up
        if cone:
            source, detector = proj_geom["DistanceOriginSource"], proj_geom["DistanceOriginDetector"]
            vectors = np.stack([source * along, -detector * along, columns, rows], axis=1)
        else:
            vectors = np.stack([along, np.zeros_like(along), columns, rows], axis=1)
    vectors[:, 1] -= (proj_geom["DetectorColCount"] - 1) / 2 * vectors[:, 2]
    vectors[:, 1] -= (proj_geom["DetectorRowCount"] - 1) / 2 * vectors[:, 3]
    return cone, vectors
