"""Part of a scanner's pictures as arrays whose rows ascend with z and whose columns are as seen from the source."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.checks import require_shape
from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.scan.frame_mean import FrameMean
from tomo_polysplat.scan.readers.acquisition import Acquisition
from tomo_polysplat.scan.readers.frames import Frames
from tomo_polysplat.scan.readers.part import Part

__all__ = ["Upright"]


class Upright:
    """Pictures of an acquisition, read when asked for.

    Parameters
    ----------
    told : Acquisition
    part : Part
        What to read of them.
    limit : float
        Numbers from which a pixel is saturated. A square of pixels with such a one among them is saturated too.

    Attributes
    ----------
    shape : (views, rows, columns)
        Of what is read.
    chosen : array of int
        Numbers of the views.
    rows, columns : (first, end)
        What is read of the whole detector, counted as the arrays are.
    """

    def __init__(self, told: Acquisition, part: Part, limit: float) -> None:
        views, rows, columns = told.frames.shape
        self._told, self._part, self._limit = told, part, limit
        high, wide = part.row_span(rows), part.column_span(columns)
        self._window = (slice(*high), slice(*wide))
        self.chosen = part.chosen_views(views)
        self.rows = (rows - high[1], rows - high[0]) if told.top_first else high
        self.columns = (columns - wide[1], columns - wide[0]) if told.from_detector else wide
        step = part.binning
        self.shape = (
            len(self.chosen),
            (high[1] - high[0]) // (1 if high[1] - high[0] == 1 else step),
            (wide[1] - wide[0]) // step,
        )

    def views(self, block: slice) -> np.ndarray:
        """Some of the chosen views, (views, rows, columns)."""
        return self._read(self._told.frames, self.chosen[block])

    def mean(self, frames: Frames, name: str) -> np.ndarray:
        """Mean of all pictures of another stack of the same detector, (rows, columns) float64."""
        size = np.broadcast_to(np.uint8(0), frames.shape[1:])
        remedy = f"take {name} of the same scan, neither binned nor cut out"
        require_shape(name, size, self._told.frames.shape[1:], "(rows, columns) of the projections", remedy)
        images = FrameMean()
        for index in range(frames.shape[0]):
            images.add(self._read(frames, [index])[0])
        return images.mean(name)

    def bright(self, share: float) -> float:
        """The value that so many percent of the pixels of a few views are below."""
        some = evenly_spread(len(self.chosen), 8)
        pictures = [self.views(slice(k, k + 1)) for k in some]
        return float(np.nanpercentile(np.concatenate(pictures), share))

    def _read(self, frames: Frames, indices: np.ndarray | list[int]) -> np.ndarray:
        pictures = np.stack([frames.read(int(index), *self._window) for index in indices])
        if self._part.binning > 1:
            pictures = self._averaged(pictures)
        pictures = pictures[:, ::-1] if self._told.top_first else pictures
        return pictures[:, :, ::-1] if self._told.from_detector else pictures

    def _averaged(self, pictures: np.ndarray) -> np.ndarray:
        averaged = self._part.averaged(pictures)
        if np.isfinite(self._limit):
            full = self._part.averaged((pictures >= self._limit).astype(np.float32)) > 0
            averaged[full] = self._limit
        return averaged
