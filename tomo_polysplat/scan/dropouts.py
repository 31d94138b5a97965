"""Rays that hold a filler instead of a measurement: zeros where the object stands in the beam."""

from __future__ import annotations

import numpy as np

__all__ = ["dropped_rays"]

# Programs that repair a scan by writing zeros do so in pixels, not in areas. Longer runs of zeros are air in a
# noiseless simulation.
LONGEST_RUN = 3
# Share of a row's largest value that both ends of a run must reach.
SMALLEST_NEIGHBOUR = 0.2
# Share of the value one further out that they must reach. At the rim of a round object chords grow as the square
# root of the depth, so that the outermost pixel has at most 1 / sqrt(2) of the next: air between two
# objects that almost touch is not taken for a dropout.
STEEPEST_RIM = 0.75


def dropped_rays(projections: np.ndarray) -> np.ndarray:
    """Find exact zeros that cannot be air, because the object stands on both sides of them.

    Parameters
    ----------
    projections : array, shape (..., columns)
        Line integrals. Values that are not finite end a run of zeros without supporting it.

    Returns
    -------
    bool array, shape of `projections`
        True in runs of at most three zeros between two values above a fifth of the row's largest that do not
        fall off towards the run.
    """
    zero = projections == 0
    dropped = np.zeros(projections.shape, bool)
    columns = projections.shape[-1]
    if columns < 3 or not zero.any():
        return dropped
    finite = np.where(np.isfinite(projections), projections, 0)
    solid = finite > SMALLEST_NEIGHBOUR * finite.max(axis=-1, keepdims=True)
    before, after = solid.copy(), solid.copy()
    before[..., 1:] &= finite[..., 1:] > STEEPEST_RIM * finite[..., :-1]
    after[..., :-1] &= finite[..., :-1] > STEEPEST_RIM * finite[..., 1:]
    for length in range(1, min(LONGEST_RUN, columns - 2) + 1):
        inside = columns - length - 1
        run = before[..., :inside] & after[..., length + 1 :]
        for step in range(1, length + 1):
            run = run & zero[..., step : step + inside]
        for step in range(1, length + 1):
            dropped[..., step : step + inside] |= run
    return dropped
