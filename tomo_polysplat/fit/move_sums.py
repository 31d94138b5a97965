"""Sums over the rays of what a fit leaves and of how that would change were the scanner moved."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from tomo_polysplat.fit.by_views import Batch, Walk, by_views, views_at_once
from tomo_polysplat.fit.clipped import allowed_error, clipped, usual_error
from tomo_polysplat.fit.loss import misfit_by_view
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.scan.moved_rays import falls_on
from tomo_polysplat.settings import Settings

__all__ = ["MoveSums", "move_sums"]

# Views looked at together, and rays, beside a step's memory, which a GPU keeps.
_AT_ONCE, _RAYS = 24, 1 << 23
# Weights of a Gaussian of one pixel. Both sides are smoothed with it, so that noise has less of a part in the slopes.
_BLUR = (0.0545, 0.2442, 0.4026, 0.2442, 0.0545)


@dataclass(frozen=True)
class MoveSums:
    """Normal equations of moves, view by view.

    Attributes
    ----------
    normal : (2, views, moves + 1, moves + 1) array
        Sums of products of slopes, of the left half of the detector and of the right one. The last slope is that of
        -log of the view's light, 1.
    told : (2, views, moves + 1) array
        Sums of slopes times measurement less model.
    held_out : (views,) array
        Mean misfit of the rays held out; NaN in views without any.
    rows : float
        How much of what rows differ by in the model the rays held out show, less its standard error: about 1, or less
        than 0 where it is noise that was fitted; 1 where no ray is held out.
    """

    normal: np.ndarray
    told: np.ndarray
    held_out: np.ndarray
    rows: float


def move_sums(
    gaussians: Gaussians, scene: FitScene, rays: Rays, settings: Settings, falls: torch.Tensor
) -> MoveSums:
    """Those of all views; each rank adds up a part of them.

    Parameters
    ----------
    gaussians, scene, rays, settings
        Of the fit.
    falls : (moves, views, 3, 3) float64 tensor
        How rays shift on the detector with each move (`scan.moved_rays.falls_of`).
    """
    falls = falls.to(rays.target, torch.float32)
    at_once = views_at_once(rays, _AT_ONCE, _RAYS, len(falls) + 1)
    walk = Walk(gaussians, scene, rays, settings, np.arange(len(rays.views)), at_once)
    parts = by_views(_of_part, walk, falls)
    normal, told, held_out, rows = (torch.cat(of_each).cpu().numpy() for of_each in zip(*parts))
    own, left, squares = rows.sum(axis=0)
    shown = 1.0 + (left - math.sqrt(squares)) / own if own > 0 else 1.0
    return MoveSums(normal.swapaxes(0, 1), told.swapaxes(0, 1), held_out, float(shown))


def _of_part(walk: Walk, falls: torch.Tensor) -> list[torch.Tensor]:
    """Of a part of the views, by these, what `MoveSums` has; sides come second."""
    views, columns, many = len(walk), walk.rays.views.columns, len(falls) + 1
    double = torch.zeros((), dtype=torch.float64, device=walk.rays.target)
    normal, told = double.new_zeros((views, 2, many, many)), double.new_zeros((views, 2, many))
    held_out, rows = double.new_full((views,), torch.nan), double.new_zeros((views, 3))
    for some in walk:
        held_out[some.here] = misfit_by_view(some.predicted, some.measured, some.aside, walk.settings)
        left = _left(some.measured - some.predicted, some.fitted, allowed_error(walk.settings))
        slopes, trust = _slopes(some.predicted, falls[:, some.now]), some.fitted.square()
        rows[some.here] = _of_rows(some)
        for side, half in enumerate((slice(0, columns // 2), slice(columns // 2, columns))):
            # Row by row: a GPU would make the products of a whole view on a single multiprocessor.
            one = slopes[..., half].double().transpose(1, 2)
            weighed = one * trust[:, :, None, half].double()
            normal[some.here, side] = (weighed @ one.transpose(2, 3)).sum(dim=1)
            told[some.here, side] = (weighed @ left[..., half, None].double())[..., 0].sum(dim=1)
    return [normal, told, held_out, rows]


def _left(residual: torch.Tensor, fitted: torch.Tensor, allowed: float) -> torch.Tensor:
    """What is left of the fitted rays, (views, rows, columns), smoothed; those far off count as less far ones."""
    used = (fitted > 0).to(residual.dtype)
    near = clipped(residual, fitted, usual_error(residual, fitted, allowed))
    return _smoothed(near * used) / _smoothed(used).clamp(min=1e-6)


def _of_rows(some: Batch) -> torch.Tensor:
    """(views, 3) sums over rays held out: of squares of what rows differ by in the model, and times what is left."""
    weight = some.aside.double().square()
    own = (some.predicted - some.predicted.mean(dim=1, keepdim=True)).double()
    left = own * (some.measured - some.predicted) * weight
    return torch.stack(
        [(own.square() * weight).sum(dim=(1, 2)), left.sum(dim=(1, 2)), left.square().sum(dim=(1, 2))], 1
    )


def _slopes(predicted: torch.Tensor, falls: torch.Tensor) -> torch.Tensor:
    """(views, moves + 1, rows, columns) change of smoothed images with each move, and 1."""
    image = _smoothed(predicted) / _smoothed(torch.ones_like(predicted))
    rows, columns = (torch.arange(n, device=image.device, dtype=image.dtype) for n in image.shape[1:])
    across, down = falls_on(falls, columns, rows)
    slopes = across * _slope(image, 2) + down * _slope(image, 1)
    return torch.cat([slopes, torch.ones_like(slopes[:1])]).transpose(0, 1)


def _smoothed(images: torch.Tensor) -> torch.Tensor:
    """(views, rows, columns) images smoothed by a pixel along both; what lies beside them is 0."""
    half = len(_BLUR) // 2
    # No convolution: a GPU's may round to ten bits.
    for axis, pad in ((2, (half, half)), (1, (0, 0, half, half))):
        wide, many = torch.nn.functional.pad(images, pad), images.shape[axis]
        images = sum(
            (share * wide.narrow(axis, k, many) for k, share in enumerate(_BLUR)), torch.zeros_like(images)
        )
    return images


def _slope(images: torch.Tensor, axis: int) -> torch.Tensor:
    """Central differences along an axis, one-sided at the ends; 0 where there is but one pixel."""
    if images.shape[axis] < 2:
        return torch.zeros_like(images)
    slope: torch.Tensor = torch.gradient(images, dim=axis)[0]
    return slope
