"""A run near its metal alone: the rays of a window of the detector, in some of the views.

A question about the rays at metal needs no others. The window is a small part of the detector where metal is a small
part of the object, so both ways of going on cost little.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from tomo_polysplat.fit.fitter import Fitter
from tomo_polysplat.fit.loss import misfit
from tomo_polysplat.fit.rays import Rays, batches_around
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.render.renderer import project_gaussians

__all__ = ["CloseUp", "close_up"]

# Rays at metal: they and their neighbours see this share of the most metal that any does.
_SEEN = 0.05
# Pixels around them that a detector's blur, and Gaussians which go astray, may reach.
_AROUND = 4


@dataclass(frozen=True)
class CloseUp:
    """A window of the detector that sees the metal, in some views.

    Attributes
    ----------
    fitter : Fitter
        The run, as it stands.
    rays : Rays
        Those of the window.
    """

    fitter: Fitter
    rays: Rays

    @torch.no_grad()
    def misfit_at_metal(self, branch: Fitter) -> float:
        """Mean misfit that a branch leaves of the rays which meet the run's metal, and of their neighbours."""
        total, weighed = 0.0, 0.0
        for views, measured, weight, _ in batches_around(self.rays):
            weight = weight * _at_metal(self.fitter, views)
            sum_of_weights = float(weight.sum())
            weighed += sum_of_weights
            predicted, _ = branch.scene.projections(branch.gaussians, views)
            total += sum_of_weights * float(misfit(predicted, measured, weight, branch.settings))
        return total / weighed if weighed else 0.0


@torch.no_grad()
def close_up(fitter: Fitter, views: int) -> CloseUp | None:
    """The window around all rays at metal, in so many views at most; None where no ray meets metal."""
    rays = fitter.rays
    met = torch.zeros((rays.views.rows, rays.views.columns), dtype=torch.bool, device=rays.target)
    for some, _, _, _ in batches_around(rays):
        met |= _at_metal(fitter, some).amax(dim=0) > 0
    if not bool(met.any()):
        return None
    window = []
    for axis, size in enumerate(met.shape):
        low, high = torch.nonzero(met.any(dim=1 - axis)).flatten()[[0, -1]].tolist()
        window.append(slice(max(0, low - _AROUND), min(size, high + 1 + _AROUND)))
    chosen = np.unique(np.linspace(0, len(rays.views) - 1, min(views, len(rays.views))).astype(int))
    return CloseUp(fitter, rays.part(chosen, window[0], window[1]))


def _at_metal(fitter: Fitter, views: DetectorViews) -> torch.Tensor:
    """(views, rows, columns) whether a ray meets the run's metal, or one beside it does."""
    metal = fitter.gaussians.select(torch.nonzero(fitter.gaussians.group > 0).flatten())
    seen, _ = project_gaussians(metal, metal.attenuation[None], views, fitter.scene.kernel)
    met = (seen > _SEEN * seen.max()).to(seen.dtype)
    reach = (min(views.rows, 3), min(views.columns, 3))
    padding = (reach[0] // 2, reach[1] // 2)
    return torch.nn.functional.max_pool2d(met, reach, 1, padding)[0, :, : views.rows, : views.columns]
