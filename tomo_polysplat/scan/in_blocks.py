"""Line integrals of counts that lie somewhere else, a block of views at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.free_memory import available_memory
from tomo_polysplat.parallel import kept_threads
from tomo_polysplat.progress import progress_reports
from tomo_polysplat.scan.counts import Counts

__all__ = ["line_integrals", "looked_through"]

# What a ray takes when it is read: a float32 and whether it is good, and as much again when a scan is made of them.
_RAY_BYTES = 10

Progress = bool | Callable[[float, str], Any] | None


def line_integrals(
    counts: Counts, progress: Progress = None
) -> tuple[np.ndarray, np.ndarray, dict[str, int]]:
    """What `tomo_polysplat.scan.defects.attenuation` makes of all views.

    Parameters
    ----------
    counts : Counts
    progress : bool, callable or None
        See `progress_reports`; None says nothing of what is read in a moment.

    Returns
    -------
    projections, valid : (rows, views, columns) float32 and bool
    found : dict
        How many rays of each kind were found.

    Raises
    ------
    MemoryError
        If they are larger than the free memory.
    """
    memory, needed = available_memory(), _RAY_BYTES * counts.size
    if memory is not None and needed > memory:
        remedy = "pass binning=, views= or rows= (--binning, --views, --rows)"
        sizes = (f"{size / 2**30:.1f} GiB" for size in (memory, needed))
        raise fail("path", f"at most {next(sizes)}, the free memory", next(sizes), remedy, MemoryError)
    projections, valid = np.empty(counts.shape, np.float32), np.empty(counts.shape, bool)
    with _reading(counts, progress) as (rays, add):
        for block in counts.blocks():
            projections[:, block.views] = block.values.transpose(1, 0, 2)
            valid[:, block.views] = block.usable.transpose(1, 0, 2)
            add(block.views, block.found)
    return projections, valid, rays


def looked_through(counts: Counts, progress: Progress = None) -> dict[str, int]:
    """How many rays of each kind were found, without keeping any: a damaged file is refused at once."""
    with _reading(counts, progress) as (rays, add):
        for views, found in counts.unusable():
            add(views, found)
    counts.found = rays
    return rays


@contextmanager
def _reading(
    counts: Counts, progress: Progress
) -> Iterator[tuple[dict[str, int], Callable[[slice, dict[str, int]], None]]]:
    """How many rays of each kind there are so far, and what adds those of some views and reports; by kept threads."""
    rays: dict[str, int] = {}
    at_once = progress is None and counts.shape[1] <= counts.at_once
    with kept_threads(), progress_reports(False if at_once else progress) as report:

        def add(views: slice, found: dict[str, int]) -> None:
            for name, count in found.items():
                rays[name] = rays.get(name, 0) + count
            report(views.stop / counts.shape[1], "reading")

        yield rays, add
