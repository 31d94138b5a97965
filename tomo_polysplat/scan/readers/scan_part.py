"""Part of a scan that has been read already."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from tomo_polysplat.scan.flattened import flattened
from tomo_polysplat.scan.readers.part import Part
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.scan.stored_part import part_of_geometry

__all__ = ["scan_part"]


def scan_part(scan: Scan, part: Part, asked: Mapping[str, Any] | None = None) -> Scan:
    """The chosen rows, columns and views, averaged; rows and columns are counted as the scan's arrays are.

    What rays are averaged are light, not its logarithm. A truth goes with another volume, and is dropped unless views
    are all that is left out. A curved detector is made flat first. `asked` is the volume of the part, if it was chosen.
    """
    scan = flattened(scan)
    rows, columns = part.row_span(scan.rows), part.column_span(scan.columns)
    views = part.chosen_views(scan.views)
    inside = (slice(*rows), views, slice(*columns))
    projections = scan.projections[slice(*rows)][:, views][:, :, slice(*columns)].transpose(1, 0, 2)
    valid = None if scan.valid is None else scan.valid[inside].transpose(1, 0, 2)
    if part.binning > 1:
        light = np.exp(-projections)
        light[np.isposinf(projections)] = 0.0
        with np.errstate(divide="ignore"):
            projections = -np.log(part.averaged(light))
        valid = None if valid is None else part.averaged(valid.astype(np.float32)) == 1
    filters = scan.filter_map
    if filters is not None:
        of_pixels = np.broadcast_to(filters[1], (scan.rows, scan.columns))[slice(*rows), slice(*columns)]
        whole = part.averaged(of_pixels[None])[0] if part.binning > 1 else of_pixels
        filters = (filters[0], np.array(whole), *filters[2:])
    proj_geom, vol_geom = part_of_geometry(part, scan.proj_geom, scan.vol_geom, (rows, columns), asked)
    kept: dict[str, Any] = {}
    if vol_geom is not None:
        kept = {"vol_geom": vol_geom, "truth": None, "metal_mask": None}
    return replace(
        scan,
        projections=projections.transpose(1, 0, 2),
        valid=None if valid is None else valid.transpose(1, 0, 2),
        proj_geom=proj_geom,
        filter_map=filters,
        **kept,
    )
