"""Parallel projections of a few discs, in closed form."""

import numpy as np

COLUMNS, ROWS = 63, 2
CENTRE = 27.3


def discs(angles, columns=COLUMNS, centre=CENTRE):
    """Closed-form parallel projections (rows, views, columns) of three discs: 2 sqrt(r^2 - distance^2)."""
    position = np.arange(columns) + 0.5 - centre
    sinogram = np.zeros((len(angles), columns))
    for x, y, radius, value in ((6.0, 3.0, 9.0, 0.05), (-9.0, 4.0, 5.0, 0.1), (2.0, -11.0, 4.0, 0.2)):
        middle = x * np.cos(angles) + y * np.sin(angles)
        chord = radius**2 - (position[None] - middle[:, None]) ** 2
        sinogram += value * 2 * np.sqrt(np.clip(chord, 0, None))
    return np.stack([sinogram, 0.5 * sinogram])
