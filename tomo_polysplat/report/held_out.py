"""Which rays a fit has not seen: they judge it, and a report tells of them apart."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.render.renderer import detector_views
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.scan.snapped import snapped_geometry
from tomo_polysplat.scan.view_order import of_same_geometry, view_order

__all__ = ["HeldOut"]


class HeldOut:
    """The rays held out of a fit, which chooses them by the number of their pixel and of their view in its own order.

    Parameters
    ----------
    geometry, grid : Geometry, VolumeGrid
        Of the scan, in its own order of the views.
    values : array (views, rows, columns), or what gives (rows, columns) by the number of a view
        Its rays; of `views_told_by_values` alone they are asked.
    share : float
        Of the rays that is held out.
    device : torch.device
        Where the answers are wanted.
    """

    # One parameter for each thing that the choice follows from.
    def __init__(
        self, geometry: Geometry, grid: VolumeGrid, values: Any, share: float, device: torch.device
    ) -> None:
        order = view_order(_in_a_fit(geometry, grid), values)
        self._rank = np.argsort(order)
        # The choice does not depend on what was measured; one number stands for all.
        blank = torch.zeros(1, 1, 1, device=device).expand(geometry.shape)
        self._rays = Rays(blank, detector_views(geometry.select(order), False), math.inf, 1.0, share)

    @staticmethod
    def views_told_by_values(geometry: Geometry, grid: VolumeGrid) -> np.ndarray:
        """Numbers of the views that only what was measured tells apart."""
        return np.flatnonzero(of_same_geometry(_in_a_fit(geometry, grid)))

    def of(self, views: np.ndarray) -> torch.Tensor:
        """(n, rows, columns) whether each ray of these views was held out."""
        return self._rays.aside(self._rank[views])


def _in_a_fit(geometry: Geometry, grid: VolumeGrid) -> Geometry:
    """The geometry in the solver's coordinates."""
    return snapped_geometry(geometry.normalised(grid.centre, 0.5 * float(grid.extent.max())))
