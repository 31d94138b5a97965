"""Sums over the rays of what a fit leaves and of how that would change with the filter in front of each pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from tomo_polysplat.fit.by_views import by_views, portions_of, views_at_once
from tomo_polysplat.fit.loss import misfit_by_view
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.physics.quadrature import Quadrature
from tomo_polysplat.settings import Settings

__all__ = ["FilterSums", "filter_sums"]

# Views looked at together, and rays, of which there are as many for each node of the spectrum.
_AT_ONCE, _RAYS = 8, 1 << 21
# Residuals beyond so many usual ones of some views, or of what a model is allowed, count as so many.
_FAR, _LEAST_ERROR = 4.0, 1e-3


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
    at_once, fit = views_at_once(rays, _AT_ONCE, _RAYS), (gaussians, scene, rays, settings)
    parts = by_views(_of_part, len(rays.views), at_once, *fit, quadrature, grams)
    (first, *more), held_out = zip(*parts)
    return FilterSums(sum(more, first).cpu().numpy(), torch.cat(held_out).cpu().numpy())


# As `fit.by_views` calls it.
def _of_part(
    part: slice,
    at_once: int,
    gaussians: Gaussians,
    scene: FitScene,
    rays: Rays,
    settings: Settings,
    quadrature: Quadrature,
    grams: float,
) -> list[torch.Tensor]:
    """Of a part of the views what `FilterSums` has."""
    shape = rays.views.rows, rays.views.columns
    sums = torch.zeros((5, *shape), dtype=torch.float64, device=rays.target)
    held_out = torch.full((part.stop - part.start,), torch.nan, dtype=torch.float64, device=rays.target)
    allowed = max(settings.model_error, _LEAST_ERROR)
    for now, here in portions_of(part, at_once):
        seen, measured, fitted, aside = rays.batch(np.arange(now.start, now.stop))
        predicted, _ = scene.projections(gaussians, seen)
        slopes = scene.filter_slopes(gaussians, seen, quadrature) * grams
        left = _clipped(measured - predicted, fitted, allowed)
        parts = torch.stack([torch.ones_like(left), slopes, slopes.square(), left, slopes * left])
        sums += (parts * fitted.square()).double().sum(dim=1)
        held_out[here] = misfit_by_view(predicted, measured, aside, settings)
    return [sums, held_out]


def _clipped(residual: torch.Tensor, fitted: torch.Tensor, allowed: float) -> torch.Tensor:
    """What is left of the fitted rays; those far off count as less far ones."""
    used = (fitted > 0).to(residual.dtype)
    usual = ((residual * fitted).square().sum() / used.sum().clamp(min=1)).sqrt().clamp(min=allowed)
    far = _FAR * usual / fitted.clamp(min=1e-12)
    return residual.maximum(-far).minimum(far) * used
