"""Does any ray see each voxel?"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.scan.coverage import coverage
from tomo_polysplat.scan.probes.finding import DEFECT, OK, UNKNOWN, Finding
from tomo_polysplat.scan.probes.measured import Measured
from tomo_polysplat.scan.volume_grid import VolumeGrid

__all__ = ["COVERAGE", "probe_coverage"]

COVERAGE = "coverage"
# Voxels along an axis that are looked at; share of the volume that may go unseen; matter in the outermost rows, as a
# share of the scan's large values.
_MOST_VOXELS, _TOLERATED, _MATTER = 40, 0.005, 0.1


def probe_coverage(measured: Measured) -> Finding:
    """Count voxels that no view sees, and ask whether the object goes on where they are."""
    grid = measured.grid
    slices, rows, columns = (min(n, _MOST_VOXELS) for n in grid.shape)
    coarse = VolumeGrid((slices, rows, columns), grid.lower, grid.upper)
    seen = coverage(measured.geometry, coarse, np.asarray(measured.valid.any(axis=1)))
    unseen = float(np.mean(seen == 0))
    numbers = {"unseen": unseen, "largest share of views": float(seen.max())}
    if unseen <= _TOLERATED:
        return Finding(COVERAGE, OK, "every part of the volume is seen by some ray", "", numbers)
    text = f"no ray sees {100 * unseen:.2g} % of the volume: what is there is not measured, which is not air"
    remedy = "make the volume no larger than the view, or move the detector"
    for name, row in (("first", 0), ("last", measured.scan.rows - 1)):
        values = np.where(measured.valid[row], measured.scan.projections[row], np.nan)
        # The middle half: what is truncated in rows goes on over the axis.
        quarter = values.shape[1] // 4
        middle = values[:, quarter : values.shape[1] - quarter]
        if measured.scan.rows < 2 or not np.isfinite(middle).any():
            continue
        if np.nanmedian(middle) > _MATTER * measured.level:
            text += f"; the object goes on beyond the {name} row"
            return Finding(COVERAGE, DEFECT, text, remedy, numbers)
    return Finding(COVERAGE, UNKNOWN, text, remedy, numbers)
