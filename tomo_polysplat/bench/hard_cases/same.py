"""Two volumes that must be one."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.bench.hard_cases.case import Findings

__all__ = ["relative_rms", "same_volume"]

# A GPU adds up in another order every time, and a fit of a hundred steps makes that visible.
_ON_A_GPU = 1e-2


def relative_rms(volume: np.ndarray, other: np.ndarray) -> float:
    """Root mean square difference over the root mean square of ``other``."""
    difference = np.asarray(volume, np.float64) - other
    return float(np.sqrt(np.mean(difference**2)) / np.sqrt(np.mean(np.square(other, dtype=np.float64))))


def same_volume(
    findings: Findings, volume: np.ndarray, other: np.ndarray, device: str, what: str, rounding: float = 0.0
) -> None:
    """That two volumes agree to ``rounding``: bit by bit on a CPU where that is 0."""
    bound = max(rounding, _ON_A_GPU) if device.startswith("cuda") else rounding
    findings.at_most(f"relative rms distance to the {what}", relative_rms(volume, other), bound)
