"""Line integrals of data that lie somewhere else, a block of views at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.free_memory import available_memory
from tomo_polysplat.progress import progress_reports
from tomo_polysplat.scan.defects import attenuation

__all__ = ["line_integrals"]

# Of numbers in float64, which is what the logarithm is taken of.
_BLOCK_BYTES = 2**27
# What a ray takes when it is read: a float32 and whether it is good, and as much again when a scan is made of them.
_RAY_BYTES = 10


# What the data are, a word each, and who wants to be told how far it is.
def line_integrals(
    read: Callable[[slice], np.ndarray],
    shape: tuple[int, int, int],
    kind: str,
    flat: np.ndarray | None = None,
    dark: np.ndarray | None = None,
    saturation: float | None = None,
    progress: bool | Callable[[float, str], Any] | None = None,
) -> tuple[np.ndarray, np.ndarray, dict[str, int]]:
    """What `tomo_polysplat.scan.defects.attenuation` makes of all views.

    Parameters
    ----------
    read : function of a slice of views
        Gives them as (views, rows, columns).
    shape : (views, rows, columns)
    kind, flat, dark, saturation
        See `attenuation`.
    progress : bool, callable or None
        See `progress_reports`; None says nothing of what is read in a moment.

    Returns
    -------
    projections, valid : (rows, views, columns) float32 and bool
    counts : dict
        How many rays of each kind were found.

    Raises
    ------
    MemoryError
        If they are larger than the free memory.
    """
    views, rows, columns = shape
    memory = available_memory()
    needed = _RAY_BYTES * views * rows * columns
    if memory is not None and needed > memory:
        remedy = "pass binning=, views= or rows= (--binning, --views, --rows)"
        sizes = (f"{size / 2**30:.1f} GiB" for size in (memory, needed))
        raise fail("path", f"at most {next(sizes)}, the free memory", next(sizes), remedy, MemoryError)
    projections = np.empty((rows, views, columns), np.float32)
    valid = np.empty((rows, views, columns), bool)
    rays: dict[str, int] = {}
    block = max(1, _BLOCK_BYTES // (rows * columns * 8))
    at_once = progress is None and views <= block
    with progress_reports(False if at_once else progress) as report:
        for first in range(0, views, block):
            part = slice(first, min(first + block, views))
            values, usable, counts = attenuation(read(part), kind, flat, dark, saturation)
            projections[:, part], valid[:, part] = values.transpose(1, 0, 2), usable.transpose(1, 0, 2)
            rays = {name: rays.get(name, 0) + count for name, count in counts.items()}
            report(part.stop / views, "reading")
    return projections, valid, rays
