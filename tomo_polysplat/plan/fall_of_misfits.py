"""How much better the held-out rays of a second fit are explained than those of a first one, view by view."""

from __future__ import annotations

import math

import numpy as np

__all__ = ["fall_of_misfits"]


def fall_of_misfits(before: np.ndarray, after: np.ndarray, unknown: float) -> tuple[float, float]:
    """By what share the misfits of the views fall, and its standard error; of fewer than two ``unknown``, inf."""
    both = np.isfinite(before) & np.isfinite(after)
    fall, mean = (before - after)[both], float(before[both].mean()) if both.any() else 0.0
    if not mean > 0 or len(fall) < 2:
        return unknown, math.inf
    return float(fall.mean()) / mean, float(fall.std(ddof=1)) / math.sqrt(len(fall)) / mean
