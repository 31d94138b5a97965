"""Measured views where a kernel can read them: all of them on the device, or those of the next step."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch

from tomo_polysplat.parallel import copy_array

__all__ = ["Feed", "ResidentFeed", "StreamedFeed", "feed"]


class Feed(Protocol):
    """Views on the device.

    Attributes
    ----------
    projections : (slots, rows, columns) tensor
        On the device; its address does not change.
    """

    projections: torch.Tensor

    def place(self, views: np.ndarray) -> np.ndarray:
        """Slots in which whatever is enqueued next will find these views."""

    def used(self) -> None:
        """All that reads the placed views has been enqueued."""


def feed(projections: torch.Tensor, device: torch.device, batch: int) -> Feed:
    """The feed for projections that are on the device, or on the host because they do not fit there."""
    return (
        ResidentFeed(projections)
        if projections.device == device
        else StreamedFeed(projections, device, batch)
    )


class ResidentFeed:
    """Every view has its place."""

    def __init__(self, projections: torch.Tensor) -> None:
        self.projections = projections

    def place(self, views: np.ndarray) -> np.ndarray:
        """The views themselves; see `Feed`."""
        return views

    def used(self) -> None:
        """Nothing to keep; see `Feed`."""


class StreamedFeed:
    """Two sets of slots in turn: one is filled, through page-locked memory of its size, while the other is read.

    The projections themselves are not locked: torch does that in a copy of up to twice their size, which it keeps.
    """

    def __init__(self, projections: torch.Tensor, device: torch.device, batch: int) -> None:
        self._host, self._batch, self._turn = projections, batch, 0
        shape = (2 * batch, *projections.shape[1:])
        self._locked = torch.empty(shape, dtype=projections.dtype, pin_memory=True)
        self.projections = torch.empty(shape, device=device)
        self._stream = torch.cuda.Stream(device)
        self._free = [torch.cuda.Event(), torch.cuda.Event()]
        self._left = [torch.cuda.Event(), torch.cuda.Event()]

    def place(self, views: np.ndarray) -> np.ndarray:
        """Slots that the views are copied to; see `Feed`."""
        slots = self._turn * self._batch + np.arange(len(views))
        # What this turn locked before must have left; at once where it was never recorded.
        self._left[self._turn].synchronize()
        with torch.cuda.stream(self._stream):
            self._stream.wait_event(self._free[self._turn])
            for slot, view in zip(slots.tolist(), views.tolist()):
                copy_array(self._locked[slot].numpy(), self._host[view].numpy())
                self.projections[slot].copy_(self._locked[slot], non_blocking=True)
            self._left[self._turn].record(self._stream)
        torch.cuda.current_stream(self.projections.device).wait_stream(self._stream)
        return slots

    def used(self) -> None:
        """The slots of this turn may be filled again after what has been enqueued; see `Feed`."""
        self._free[self._turn].record(torch.cuda.current_stream(self.projections.device))
        self._turn = 1 - self._turn
