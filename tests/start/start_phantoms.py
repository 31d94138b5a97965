"""Spheres (discs, in a planar scan), whose line integrals are chords."""

import numpy as np

# Centre, radius, attenuation added where spheres overlap.
SPHERES = (((0.0, 0.0, 0.0), 20.0, 0.02), ((8.0, -6.0, 3.0), 6.0, 0.03), ((-9.0, 4.0, -5.0), 4.0, 0.05))
DISCS = (((0.0, 0.0, 0.0), 20.0, 0.02), ((8.0, -6.0, 0.0), 6.0, 0.03), ((-9.0, 10.0, 0.0), 3.0, 0.05))


def chords(geometry, spheres, scale=1.0):
    """Projections (views, rows, columns) float32; lengths times ``scale``."""
    projections = np.zeros(geometry.shape)
    for centre, radius, value in spheres:
        projections += value * paths(geometry, scale * np.asarray(centre), scale * radius)
    return projections.astype(np.float32)


def paths(geometry, centre, radius, flat=(1.0, 1.0, 1.0)):
    """Lengths (views, rows, columns) of rays inside of an ellipsoid whose half-axes are ``radius / flat``.

    A ray is at ``begin + t ahead``; numbers of axes, one by one, are several times as quick as vectors of three.
    """
    lengths, flat = np.empty(geometry.shape), np.asarray(flat)
    column, row = np.arange(geometry.columns), np.arange(geometry.rows)[:, None]
    for view in range(geometry.views):
        origin, corner, u, v = (getattr(geometry, name)[view] for name in ("origin", "corner", "u", "v"))
        parallel = geometry.beam == "parallel"
        pixels = [
            start + column * across + row * down
            for start, across, down in zip(corner - (centre if parallel else origin), u, v)
        ]
        begin, ahead = (pixels, origin) if parallel else (origin - centre, pixels)
        square = sum((f * d) ** 2 for f, d in zip(flat, ahead))
        product = sum(f**2 * b * d for f, b, d in zip(flat, begin, ahead))
        beyond = sum((f * b) ** 2 for f, b in zip(flat, begin)) - radius**2
        inside = 2 * np.sqrt(np.maximum(product**2 - square * beyond, 0)) / square
        lengths[view] = inside * np.sqrt(sum(d**2 for d in ahead))
    return lengths


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
