"""How many views have their footprints in a GPU's memory together."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["FEW_VIEWS", "MANY", "portions", "views_at_once"]

# So many Gaussians fill a GPU with the footprints of so few views: more views at once would only take memory.
MANY, FEW_VIEWS = 1_000_000, 3


def views_at_once(views: int, gaussians: int) -> int:
    """Of so many views, those whose footprints are held together."""
    return min(views, FEW_VIEWS) if gaussians >= MANY else views


def portions(views: DetectorViews, gaussians: int) -> list[DetectorViews]:
    """The views, in their order, parted by how many are held together."""
    most = max(views_at_once(len(views), gaussians), 1)
    if most >= len(views):
        return [views]
    return [
        views.select(np.arange(first, min(first + most, len(views)))) for first in range(0, len(views), most)
    ]
