"""Spheres (discs, in a planar scan), whose line integrals are chords."""

import numpy as np

# Centre, radius, attenuation added where spheres overlap.
SPHERES = (((0.0, 0.0, 0.0), 20.0, 0.02), ((8.0, -6.0, 3.0), 6.0, 0.03), ((-9.0, 4.0, -5.0), 4.0, 0.05))
DISCS = (((0.0, 0.0, 0.0), 20.0, 0.02), ((8.0, -6.0, 0.0), 6.0, 0.03), ((-9.0, 10.0, 0.0), 3.0, 0.05))


def chords(geometry, spheres, scale=1.0):
    """Projections (views, rows, columns) float32; lengths times ``scale``."""
    projections = np.zeros(geometry.shape)
    for view in range(geometry.views):
        origins, directions = geometry.rays(view)
        for centre, radius, value in spheres:
            to_centre = scale * np.asarray(centre) - origins
            along = np.einsum("...i,...i", to_centre, directions)
            missed = np.einsum("...i,...i", to_centre, to_centre) - along**2
            projections[view] += 2 * value * np.sqrt(np.maximum((scale * radius) ** 2 - missed, 0))
    return projections.astype(np.float32)


def distance(grid, centre):
    x, y, z = grid.axes()
    cx, cy, cz = centre
    return np.sqrt((x - cx) ** 2 + (y[:, None] - cy) ** 2 + (z[:, None, None] - cz) ** 2)


def truth(grid, spheres):
    """The volume, with edges softened over one unit of length."""
    return sum(m * np.clip(r - distance(grid, c) + 0.5, 0, 1) for c, r, m in spheres)


def relative_error(volume, expected, within):
    """Root mean square difference over part of the volume, relative to the largest expected value."""
    return np.sqrt(np.mean((volume - expected)[within] ** 2)) / expected.max()
