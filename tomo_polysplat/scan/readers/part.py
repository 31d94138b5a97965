"""Which part of a scan to read, and how finely."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.scan.geometry import Geometry
from tomo_polysplat.scan.volume_grid import require_count

__all__ = ["Part"]


@dataclass(frozen=True)
class Part:
    """Rows, columns and views to read of the pictures as they are stored; None stands for all.

    Attributes
    ----------
    rows, columns : (first, end) or None
        As a viewer of pictures counts them, from the top left at 0; `end` is the first one that is left out.
    views : int, (first, end), (first, end, step) or None
        A number alone is the step: 2 reads every other view.
    binning : int
        Rows and columns that are averaged to one. What is left over at the bottom and on the right is dropped.
    """

    rows: Any = None
    columns: Any = None
    views: Any = None
    binning: int = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "binning", require_count("binning", self.binning))

    @property
    def whole(self) -> bool:
        """Whether everything is read as it is."""
        return (self.rows, self.columns, self.views, self.binning) == (None, None, None, 1)

    def row_span(self, rows: int) -> tuple[int, int]:
        """First row and the first one left out, of so many."""
        return self._span("rows", self.rows, rows)

    def column_span(self, columns: int) -> tuple[int, int]:
        """First column and the first one left out, of so many."""
        return self._span("columns", self.columns, columns)

    def chosen_views(self, views: int) -> np.ndarray:
        """Numbers of the views, of so many."""
        given = (None, None, self.views) if np.ndim(self.views) == 0 else tuple(self.views)
        first, end, step = (*given, None)[:3]
        step = 1 if step is None else require_count("views", step)
        if np.ndim(self.views) == 0 and 1 < views <= step:
            raise fail(
                "views", f"a step that leaves some of {views} views", f"{step}", "2 takes every other view"
            )
        first, end = _ends("views", (0 if first is None else first, views if end is None else end), views)
        return np.arange(first, end, step)

    def of(self, geometry: Geometry, spans: tuple[tuple[int, int], tuple[int, int]]) -> Geometry:
        """The geometry of the part: chosen views of these rows and columns, averaged."""
        chosen = geometry.select(self.chosen_views(geometry.views)).cropped(*spans)
        return chosen.binned(self.binning) if self.binning > 1 else chosen

    def averaged(self, pictures: np.ndarray) -> np.ndarray:
        """Pictures (n, rows, columns) averaged over squares; one row stays one."""
        if self.binning == 1:
            return pictures
        n, rows, columns = pictures.shape
        high, wide = (1 if rows == 1 else self.binning), self.binning
        kept = pictures[:, : rows - rows % high, : columns - columns % wide]
        squares = kept.reshape(n, rows // high, high, columns // wide, wide)
        return squares.mean(axis=(2, 4), dtype=np.float32)

    def _span(self, name: str, given: Any, most: int) -> tuple[int, int]:
        first, end = _ends(name, (0, most) if given is None else given, most)
        size = self.binning if most > 1 else 1
        if end - first < size:
            raise fail("binning", f"at most the {end - first} {name} that are read", f"{size}")
        return first, end - (end - first) % size


def _ends(name: str, given: Any, most: int) -> tuple[int, int]:
    try:
        first, end = (int(n) for n in given)
    except (TypeError, ValueError):
        raise fail(name, "two whole numbers, first and end", repr(given)) from None
    if not 0 <= first < end <= most:
        raise fail(name, f"first < end, from 0 to {most}", f"{first}, {end}")
    return first, end
