"""Projections as filtered backprojection takes them, made of some views at a time.

Bad rays are filled in, and rows that end in matter go on. Of a large scan a GPU has no room for a copy of all of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from tomo_polysplat.scan.geometry import Geometry

__all__ = ["Continuation", "WholeRows", "ends_of", "fill_rows"]

# Pixels filled at once, on a device: the intermediate results are some twenty times as large.
_AT_ONCE = {"cuda": 1 << 22, "cpu": 1 << 20}
# Share of the columns whose mean an end is taken for, against noise.
_END = 0.02


@dataclass(frozen=True, eq=False)
class Continuation:
    """How rows go on beyond both ends of a detector.

    Attributes
    ----------
    geometry : Geometry
        Of the rows with what they are continued by.
    more : int
        Columns at either end; 0 where rows stay as they are.
    reach : float
        Columns from the detector's middle to where the object ends.
    words : str
        What say so.
    """

    geometry: Geometry
    more: int = 0
    reach: float = 0.0
    words: str = ""

    def of(self, projections: torch.Tensor) -> torch.Tensor:
        """Some views and rows of the projections, all their columns, as they go on; themselves where they do not."""
        if not self.more:
            return projections
        half = 0.5 * (projections.shape[2] - 1)
        numbers = torch.arange(1, self.more + 1, device=projections.device, dtype=projections.dtype)
        share = ((self.reach**2 - (half + numbers) ** 2).clamp(min=0) / (self.reach**2 - half**2)).sqrt()
        left, right = (end[..., None].clamp(min=0) * share for end in ends_of(projections).unbind(-1))
        return torch.cat([left.flip(2), projections, right], dim=2)


@dataclass(frozen=True, eq=False)
class WholeRows:
    """What stands for a tensor of projections: a part of it becomes one on the device where it is wanted.

    Parameters
    ----------
    projections : (views, rows, columns) float32 tensor
        -log(I/I0), on any device; pixels that are not finite are interpolated from their row.
    continuation : Continuation
    views : (n,) int tensor, optional
        Those that are meant, on that device; all by default.
    """

    projections: torch.Tensor
    continuation: Continuation
    views: torch.Tensor | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """(views, rows, columns), with the columns that rows are continued by."""
        every, rows, columns = self.projections.shape
        return every if self.views is None else len(self.views), rows, columns + 2 * self.continuation.more

    @property
    def dtype(self) -> torch.dtype:
        """Of the projections."""
        return self.projections.dtype

    @property
    def device(self) -> torch.device:
        """Where the projections are."""
        return self.projections.device

    @property
    def is_cuda(self) -> bool:
        """Whether that is a GPU."""
        return self.projections.is_cuda

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, some: slice | tuple[slice, slice]) -> WholeRows:
        """Some of the views, and of their rows; nothing is made yet."""
        views, rows = some if isinstance(some, tuple) else (some, slice(None))
        if self.views is None:
            return WholeRows(self.projections[views, rows], self.continuation)
        return WholeRows(self.projections[:, rows], self.continuation, self.views[views])

    def to(self, device: torch.device) -> torch.Tensor:
        """All of it on a device; the projections themselves where nothing has to be made of them."""
        some = self.projections if self.views is None else self.projections[self.views]
        return self.continuation.of(fill_rows(some.to(device)))


def ends_of(values: torch.Tensor) -> torch.Tensor:
    """(..., 2) means of the first and of the last few columns."""
    few = max(1, round(_END * values.shape[-1]))
    return torch.stack([values[..., :few].mean(dim=-1), values[..., -few:].mean(dim=-1)], dim=-1)


def fill_rows(projections: torch.Tensor) -> torch.Tensor:
    """Pixels that are not finite interpolated linearly along their row, as by `defects.fill_invalid`.

    Beyond the last good pixel the row goes on as it ends; a row without any becomes 0.
    """
    spoiled = (~torch.isfinite(projections)).any(dim=2).any(dim=1).nonzero()[:, 0]
    if not len(spoiled):
        return projections
    filled = projections.clone()
    at_once = max(1, _AT_ONCE[projections.device.type] // projections[0].numel())
    for views in spoiled.split(at_once):
        filled[views] = _filled(projections[views])
    return filled


def _filled(values: torch.Tensor) -> torch.Tensor:
    good, count = torch.isfinite(values), values.shape[2]
    column = torch.arange(count, device=values.device).expand_as(values)
    before = torch.where(good, column, -1).cummax(dim=2).values
    after = torch.where(good, column, count).flip(2).cummin(dim=2).values.flip(2)
    some = good.any(dim=2, keepdim=True)
    left = torch.where(before < 0, after, before).clamp(max=count - 1)
    right = torch.where(after == count, before, after).clamp(min=0)
    usable = torch.where(good, values, 0.0)
    low, high = usable.gather(2, left), usable.gather(2, right)
    # In the type of the values, whatever the caller's default for quotients of whole numbers.
    share = (column - left).to(values.dtype) / (right - left).clamp(min=1)
    return torch.where(good, values, torch.where(some, low + share * (high - low), 0.0))
