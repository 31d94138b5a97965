"""Some of many views, rows or slices, where looking at all of them would take long."""

from __future__ import annotations

import numpy as np

__all__ = ["evenly_spread"]


def evenly_spread(count: int, most: int) -> np.ndarray:
    """Numbers below ``count``, rising, at most so many, with the first and the last one among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
