"""Sums over the rays of what a fit leaves and of how that would change with the filter in front of each pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from tomo_polysplat.fit.by_views import Walk, by_views, views_at_once
from tomo_polysplat.fit.clipped import allowed_error, clipped, usual_error
from tomo_polysplat.fit.loss import misfit_by_view
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.physics.quadrature import Quadrature
from tomo_polysplat.settings import Settings

__all__ = ["FilterSums", "filter_sums"]

# Views looked at together, and rays, of which there are as many for each node of the spectrum.
_AT_ONCE, _RAYS = 8, 1 << 21


@dataclass(frozen=True)
class FilterSums:
    """Sums by pixel over the fitted rays, weighed by inverse variances up to a factor.

    Attributes
    ----------
    sums : (5, rows, columns) array
        Of 1, of the slope of -log(I/I0) by the filter's thickness (1/cm), of its square, of what is measured less the
        model, and of slope times that.
    held_out : (views,) array
        Mean misfit of the rays held out; NaN in views without any.
    """

    sums: np.ndarray
    held_out: np.ndarray


# What a fit is, and what is to be known of the filter.
def filter_sums(
    gaussians: Gaussians,
    scene: FitScene,
    rays: Rays,
    settings: Settings,
    quadrature: Quadrature,
    grams: float,
) -> FilterSums:
    """Those of all views; each rank adds up a part of them.

    Parameters
    ----------
    gaussians, scene, settings
        Of the fit.
    rays : Rays
        Their weights count, which are to be the same for fits that are compared.
    quadrature : Quadrature
        Nodes that know the filter's material.
    grams : float
        Its density in g/cm3.
    """
    numbers, at_once = np.arange(len(rays.views)), views_at_once(rays, _AT_ONCE, _RAYS)
    walk = Walk(gaussians, scene, rays, settings, numbers, at_once)
    parts = by_views(_of_part, walk, quadrature, grams)
    (first, *more), held_out = zip(*parts)
    return FilterSums(sum(more, first).cpu().numpy(), torch.cat(held_out).cpu().numpy())


def _of_part(walk: Walk, quadrature: Quadrature, grams: float) -> list[torch.Tensor]:
    """Of a part of the views what `FilterSums` has."""
    shape, device = (walk.rays.views.rows, walk.rays.views.columns), walk.rays.target
    sums = torch.zeros((5, *shape), dtype=torch.float64, device=device)
    held_out = torch.full((len(walk),), torch.nan, dtype=torch.float64, device=device)
    for some in walk:
        slopes = walk.scene.filter_slopes(walk.gaussians, some.views, quadrature) * grams
        left = _left(some.measured - some.predicted, some.fitted, allowed_error(walk.settings))
        parts = torch.stack([torch.ones_like(left), slopes, slopes.square(), left, slopes * left])
        sums += (parts * some.fitted.square()).double().sum(dim=1)
        held_out[some.here] = misfit_by_view(some.predicted, some.measured, some.aside, walk.settings)
    return [sums, held_out]


def _left(residual: torch.Tensor, fitted: torch.Tensor, allowed: float) -> torch.Tensor:
    """What is left of the fitted rays; those far off count as less far ones."""
    used = (fitted > 0).to(residual.dtype)
    return clipped(residual, fitted, usual_error(residual, fitted, allowed)) * used
