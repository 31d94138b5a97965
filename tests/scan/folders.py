"""A small scan, its folders, and volumes of both by filtered backprojection."""

from functools import cache

import numpy as np

from tomo_polysplat.scan.geometry import from_astra, projections_from_astra
from tomo_polysplat.simulate.folders.scene import MARKER, marked_scan
from tomo_polysplat.start.fdk import fdk
from tomo_polysplat.units import cm_per

__all__ = ["STATED", "error_db", "marked", "require_the_same_volume", "volume_of"]

# What nothing tells of the pictures in `tiff_stack`.
STATED = {"sod": 100.0, "sdd": 250.0, "pixel": 1.6, "offset": (2.4, 0.0), "arc": 360.0}


@cache
def marked(beam="cone"):
    return marked_scan(beam=beam)


def volume_of(scan):
    """Attenuation in 1/cm and the grid in cm."""
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    length = cm_per(scan.unit)
    return fdk(
        projections_from_astra(scan.projections, scan.proj_geom), geometry, grid
    ) / length, grid.scaled(length)


def error_db(volume, truth):
    return 10 * np.log10(np.mean((volume - truth) ** 2) / np.mean(truth**2))


def require_the_same_volume(scan, own):
    """The same voxels, as far from the truth to 0.3 dB, and the marker on its own side of every axis."""
    (volume, grid), (expected, own_grid) = volume_of(scan), volume_of(own)
    np.testing.assert_allclose(grid.voxel_size, own_grid.voxel_size, rtol=1e-6)
    np.testing.assert_allclose(grid.centre, own_grid.centre, atol=1e-6)
    assert abs(error_db(volume, own.truth) - error_db(expected, own.truth)) < 0.3
    z, y, x = np.unravel_index(np.argmax(volume), volume.shape)
    found = [axis[k] for axis, k in zip(grid.axes(), (x, y, z))]
    np.testing.assert_allclose(found, MARKER, atol=0.16)  # its radius
