"""The filter in front of the pixels that a result was made with."""

from __future__ import annotations

from typing import Any

from tomo_polysplat.physics.filter_shape import bowtie_map
from tomo_polysplat.result.data import ResultData
from tomo_polysplat.scan.scan import Scan

__all__ = ["filter_of"]


def filter_of(result: ResultData, scan: Scan) -> tuple[Any, ...] | None:
    """That which the fit has found, or the scan's; as `Scan.filter_map`, in the scan's unit."""
    if "bowtie" not in result.plan:
        return scan.filter_map
    rows, _, columns = scan.projections.shape
    return bowtie_map(result.plan["bowtie"].value, rows, columns, scan.unit)
