"""A scan with a curved detector as one with the flat detector that it is fitted on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tomo_polysplat.scan.geometry import geometry_from_astra, geometry_to_astra, projections_from_astra
from tomo_polysplat.scan.scan import Scan

__all__ = ["flattened"]


def flattened(scan: Scan) -> Scan:
    """The scan itself, unless its detector is curved: then its rays are resampled, as `reconstruct` does it.

    A ray that uses any invalid pixel is invalid, and one that uses a pixel without light is not a number.
    """
    if scan.proj_geom.get("type") != "cyl_cone_vec":
        return scan
    values = projections_from_astra(scan.projections, scan.proj_geom)
    # Copied, where nothing had to be resampled.
    values = np.where(np.isinf(values), np.float32(np.nan), values)
    good = np.isfinite(values)
    if scan.valid is not None:
        usable = np.asarray(scan.valid, np.float32)
        good &= projections_from_astra(usable, scan.proj_geom) >= 1
    return replace(
        scan,
        projections=np.ascontiguousarray(values.swapaxes(0, 1)),
        valid=None if good.all() else np.ascontiguousarray(good.swapaxes(0, 1)),
        proj_geom=geometry_to_astra(geometry_from_astra(scan.proj_geom)),
    )
