"""What a fit may use: its settings, the seconds there are, a seed and a device."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from tomo_polysplat.settings import Settings

__all__ = ["FitOptions"]


@dataclass(frozen=True)
class FitOptions:
    """How fits are made.

    Attributes
    ----------
    settings : Settings
    time_budget : float or None
        Seconds of the whole reconstruction.
    seed : int
        Of every random choice.
    device : torch.device
    """

    settings: Settings
    time_budget: float | None
    seed: int
    device: torch.device
