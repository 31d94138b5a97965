"""Gains of pixels and light of views that were taken out of what was measured, in place."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import torch

__all__ = ["Step", "TakenOut"]

# -log of gains (rows, columns) and of the light (views,), in single precision.
Step = tuple[np.ndarray, np.ndarray]


class TakenOut:
    """All that was taken out of the rays of a scan.

    Parameters
    ----------
    shape : (views, rows, columns)
    steps : list of Step
        One after the other: a run that goes on repeats them, to the last bit.
    copies : callable
        Gives the tensors of the rays, on all devices.
    """

    def __init__(
        self, shape: tuple[int, ...], steps: list[Step], copies: Callable[[], Iterable[torch.Tensor]]
    ) -> None:
        self.shape, self.steps, self._copies = shape, steps, copies

    @property
    def gains(self) -> np.ndarray:
        """(rows, columns), the sum of all steps."""
        return sum((gains for gains, _ in self.steps), np.zeros(self.shape[1:]))

    @property
    def drift(self) -> np.ndarray:
        """(views,), likewise."""
        return sum((drift for _, drift in self.steps), np.zeros(self.shape[0]))

    def add(self, gains: np.ndarray | None = None, drift: np.ndarray | None = None) -> None:
        """Take more out; whatever holds the tensors sees it."""
        of_pixels = np.zeros(self.shape[1:], np.float32) if gains is None else gains.astype(np.float32)
        of_views = np.zeros(self.shape[0], np.float32) if drift is None else drift.astype(np.float32)
        self.steps.append((of_pixels, of_views))
        for values in self._copies():
            values -= torch.from_numpy(of_pixels).to(values.device)
            values -= torch.from_numpy(of_views).to(values.device)[:, None, None]

    def told(self, order: np.ndarray | None) -> dict[str, np.ndarray]:
        """``gains`` and ``drift``, where there are any; the views as they were before they were put in ``order``."""
        drift = self.drift if order is None else self.drift[np.argsort(order)]
        parts = {"gains": self.gains.astype(np.float32), "drift": drift.astype(np.float32)}
        return {name: part for name, part in parts.items() if part.any()}
