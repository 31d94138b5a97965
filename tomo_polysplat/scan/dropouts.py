"""Rays that hold a filler instead of a measurement: zeros where the object stands in the beam."""

from __future__ import annotations

import numpy as np

__all__ = ["dropped_rays"]

# Programs that repair a scan by writing zeros do so in pixels, not in areas. Longer runs of zeros are air in a
# noiseless simulation.
LONGEST_RUN = 3
# Share of a projection's largest value that both ends of a run must reach: air beside an object does not.
SMALLEST_NEIGHBOUR = 0.2


def dropped_rays(projections: np.ndarray) -> np.ndarray:
    """Exact zeros that cannot be air, because both neighbours along the detector row are not.

    Parameters
    ----------
    projections : array, shape (..., columns)
        Line integrals. Values that are not finite end a run of zeros without supporting it.

    Returns
    -------
    bool array, shape of `projections`
        True in runs of at most three zeros between two values above a fifth of the row's largest.
    """
    zero = projections == 0
    dropped = np.zeros(projections.shape, bool)
    if not zero.any():
        return dropped
    finite = np.where(np.isfinite(projections), projections, 0)
    solid = finite > SMALLEST_NEIGHBOUR * finite.max(axis=-1, keepdims=True)
    columns = projections.shape[-1]
    for length in range(1, min(LONGEST_RUN, columns - 2) + 1):
        inside = columns - length - 1
        run = solid[..., :inside] & solid[..., length + 1 :]
        for step in range(1, length + 1):
            run = run & zero[..., step : step + inside]
        for step in range(1, length + 1):
            dropped[..., step : step + inside] |= run
    return dropped
