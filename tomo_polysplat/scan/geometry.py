"""Geometry of a scan: coordinates, detector, volume and the translation from ASTRA.

Coordinates are ``(x, y, z)`` in the unit of length of the scan, right-handed, z along the usual axis of
rotation. Inside the package projections are ``(views, rows, columns)`` and volumes ``(z, y, x)``, every
index ascending with its coordinate. A whole-number detector coordinate is the centre of a pixel; the volume
window ends at the outer faces of its voxels. ASTRA's arrays are ``(rows, views, columns)`` in 3D, where y
ascends too, and ``(views, columns)`` in 2D, where image row 0 is the *largest* y; they are turned at the
edges of the package by the functions named here, and nowhere else.
"""

from tomo_polysplat.scan.astra_geometry import (
    from_astra,
    geometry_from_astra,
    geometry_to_astra,
    grid_from_astra,
    is_planar_geometry,
    projections_from_astra,
    require_projections,
    to_astra,
    volume_from_astra,
    volume_to_astra,
)
from tomo_polysplat.scan.view_geometry import Geometry
from tomo_polysplat.scan.volume_grid import VolumeGrid

__all__ = [
    "Geometry",
    "VolumeGrid",
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
