"""Measured views where a kernel can read them: all of them on the device, or those of the next step."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch

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
    """Two sets of slots in turn: one is filled from page-locked memory while the other is read."""

    def __init__(self, projections: torch.Tensor, device: torch.device, batch: int) -> None:
        self._host = projections if projections.is_pinned() else projections.pin_memory()
        self._batch, self._turn = batch, 0
        self.projections = torch.empty((2 * batch, *projections.shape[1:]), device=device)
        self._stream = torch.cuda.Stream(device)
        self._free = [torch.cuda.Event(), torch.cuda.Event()]

    def place(self, views: np.ndarray) -> np.ndarray:
        """Slots that the views are copied to; see `Feed`."""
        slots = self._turn * self._batch + np.arange(len(views))
        with torch.cuda.stream(self._stream):
            self._stream.wait_event(self._free[self._turn])
            for slot, view in zip(slots.tolist(), views.tolist()):
                self.projections[slot].copy_(self._host[view], non_blocking=True)
        torch.cuda.current_stream(self.projections.device).wait_stream(self._stream)
        return slots

    def used(self) -> None:
        """The slots of this turn may be filled again after what has been enqueued; see `Feed`."""
        self._free[self._turn].record(torch.cuda.current_stream(self.projections.device))
        self._turn = 1 - self._turn
