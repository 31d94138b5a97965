"""Detectors made level: their rows in the plane of the orbit, where the ramp has to go along them.

On any flat detector that does not lie on its back the horizontal lines are parallel to each other. A pixel's column
and its height above such a line are as good as its column and row: each column is moved up or down by what takes the
detector's roll away, and nothing else is touched. A detector that is tilted or slanted alone has level rows already.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from tomo_polysplat.scan.geometry import Geometry

if TYPE_CHECKING:
    from tomo_polysplat.start.whole_rows import WholeRows

__all__ = ["Level", "LevelRows"]

# Rows by which the ends of a detector's own rows rise over their middle, below which they are level.
_LEVEL = 0.05
# Pixels that are brought to a device at once.
_AT_ONCE = 1 << 24
# Rows of which one is interpolated, counted from the one below it.
_TAPS = (-1, 0, 1, 2)


class Level:
    """The level detector of a scan.

    Parameters
    ----------
    told : Geometry
        Of a scan that filtered backprojection fits.

    Attributes
    ----------
    geometry : Geometry
        The level one; the one told where that is level. Its columns go through the same points of the middle column,
        and there are as many rows more at either end as it takes to keep every pixel.
    """

    def __init__(self, told: Geometry) -> None:
        self.told, self.geometry, self._more = told, told, 0
        # Rows per column that level lines fall below the detector's own.
        self._slope = -told.u[:, 2] / told.v[:, 2]
        self._middle = 0.5 * (told.columns - 1)
        rise = self._middle * float(np.abs(self._slope).max())
        self.moved = told.rows > 1 and rise >= _LEVEL
        if self.moved:
            self._more = math.ceil(rise)
            step = self._slope[:, None] * told.v
            self.geometry = replace(
                told,
                corner=told.corner - self._middle * step - self._more * told.v,
                u=told.u + step,
                rows=told.rows + 2 * self._more,
            )

    def values(
        self, projections: torch.Tensor | WholeRows, views: slice, rows: tuple[int, int], device: torch.device
    ) -> torch.Tensor:
        """What the level detector sees in some views and in its rows from the first up to, and without, the second.

        Between the rows of a column by cubic convolution (Keys 1981, doi:10.1109/TASSP.1981.1163711), which keeps more
        of what is sharp than straight lines do; beyond its ends, as it ends.

        Parameters
        ----------
        projections : (views, rows, columns) tensor or WholeRows
            Of these views, by the told detector; anywhere.
        views : slice
        rows : (int, int)
        device : torch.device
            Where they are to be.

        Returns
        -------
        (views, rows, columns) tensor
            The projections themselves where they are level and on the device.
        """
        first, last = rows
        if not self.moved:
            return projections[:, first:last].to(device)
        rise = self._slope[views, None] * (np.arange(self.told.columns) - self._middle) + (first - self._more)
        low, high = (
            int(np.clip(end, 0, self.told.rows))
            for end in (np.floor(rise.min()) + _TAPS[0], np.ceil(rise.max()) + last - first + _TAPS[-1])
        )
        # Whatever lies beyond the detector is its first or last row.
        low, high = min(low, self.told.rows - 1), max(high, 1)
        below = np.floor(rise)
        taps = torch.from_numpy(_cubic(rise - below)).to(device, projections.dtype)
        below = torch.from_numpy(below.astype(np.int64) - low).to(device)
        row = torch.arange(last - first, device=device)[:, None]
        many, kind = len(projections), projections.dtype
        seen = torch.empty((many, last - first, self.told.columns), dtype=kind, device=device)
        for portion in _portions(many, (high - low) * self.told.columns):
            here = projections[portion, low:high].to(device)
            for k, image in zip(range(portion.start, portion.stop), here):
                place = row + below[k]
                seen[k] = sum(
                    image.gather(0, (place + tap).clamp_(0, high - low - 1)) * taps[n, k]
                    for n, tap in enumerate(_TAPS)
                )
        return seen


@dataclass(frozen=True, eq=False)
class LevelRows:
    """What stands for a tensor of what the level detector sees in some of its rows: its views become one.

    Parameters
    ----------
    level : Level
    projections : (views, rows, columns) tensor or WholeRows
        By the told detector; anywhere.
    rows : (int, int)
        Of the level detector, the first and the one behind the last.
    device : torch.device
        Where they are to be.
    """

    level: Level
    projections: torch.Tensor | WholeRows
    rows: tuple[int, int]
    device: torch.device

    @property
    def shape(self) -> tuple[int, int, int]:
        """(views, rows, columns)."""
        return len(self.projections), self.rows[1] - self.rows[0], self.level.geometry.columns

    def __getitem__(self, views: slice) -> torch.Tensor:
        return self.level.values(self.projections[views], views, self.rows, self.device)


def _cubic(share: np.ndarray) -> np.ndarray:
    """Weights (4, ...) of the rows around a place so far, 0 to 1, above the second of them."""
    one, two, three = share, share**2, share**3
    return 0.5 * np.stack(
        [-three + 2 * two - one, 3 * three - 5 * two + 2, -3 * three + 4 * two + one, three - two]
    )


def _portions(views: int, pixels: int) -> Iterator[slice]:
    at_once = max(1, _AT_ONCE // pixels)
    for first in range(0, views, at_once):
        yield slice(first, min(first + at_once, views))
