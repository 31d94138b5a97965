"""Sums over the rays of measurement less model: by pixel, by view, and of the rays held out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from tomo_polysplat.fit.by_views import Walk, by_views, views_at_once
from tomo_polysplat.fit.clipped import allowed_error, clipped
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings

__all__ = ["ResidualSums", "residual_sums"]

# Blocks of views that differ by chance; ends of depths, -log(I/I0).
_BLOCKS, _DEPTHS = 8, (0.01, 0.05, 0.15, 0.3, 0.6, 1.0, 1.5, 2.0, 3.0, 4.0)
# Views looked at together, and rays, beside a step's memory, which a GPU keeps.
_AT_ONCE, _RAYS = 24, 1 << 24
# Of view, pixel, residual and deviation of a ray held out.
_OF_ASIDE = (torch.int64, torch.int64, torch.float32, torch.float32)


@dataclass(frozen=True)
class ResidualSums:
    """What rays leave.

    Attributes
    ----------
    weight, total : (blocks, rows, columns) array
        By pixel, of the fitted rays; see `nuisances.gain_estimate.gains_of_pixels`.
    count, by_depth : (2, views, depths) array
        By view, of the left half of the detector and of the right one; see `nuisances.gain_estimate.drift_of_views`.
    view, pixel : (n,) int array
        Of the rays held out; the view counted among those looked at.
    residual, deviation : (n,) array
        Of these, measurement less model and what of it is allowed.
    views : (views,) int array
        Numbers in the scan of the views looked at.
    """

    weight: np.ndarray
    total: np.ndarray
    count: np.ndarray
    by_depth: np.ndarray
    view: np.ndarray
    pixel: np.ndarray
    residual: np.ndarray
    deviation: np.ndarray
    views: np.ndarray

    def without_drift(self, drift: np.ndarray) -> ResidualSums:
        """As if the views had this log-factor, (views,), less; the rays of a pixel weigh alike in a block of views."""
        block = _blocks(len(drift), len(self.weight))
        mean = np.bincount(block, drift) / np.bincount(block)
        total = self.total - self.weight * mean[:, None, None]
        by_depth = self.by_depth - self.count * drift[:, None]
        return replace(self, total=total, by_depth=by_depth, residual=self.residual - drift[self.view])


def residual_sums(
    gaussians: Gaussians,
    scene: FitScene,
    rays: Rays,
    settings: Settings,
    some: np.ndarray | None = None,
) -> ResidualSums:
    """Those of all views, or of ``some`` by their numbers; each rank adds up a part of them."""
    numbers = np.arange(len(rays.views)) if some is None else some
    walk = Walk(gaussians, scene, rays, settings, numbers, views_at_once(rays, _AT_ONCE, _RAYS))
    parts = by_views(_of_part, walk)
    weights, totals, counts, *aside = zip(*parts)
    count, by_depth = torch.cat(counts).permute(1, 2, 0, 3).cpu().numpy()
    view, pixel, residual, deviation = (torch.cat(of_each).numpy() for of_each in aside)
    weight, total = (sum(more, first).cpu().numpy() for first, *more in (weights, totals))
    return ResidualSums(weight, total, count, by_depth, view, pixel, residual, deviation, numbers)


# One walk over the views fills all sums: cut up, each part would be handed all of them.
def _of_part(walk: Walk) -> list[torch.Tensor]:
    """Sums by pixel, those by view, (views, 2, halves, depths), and the rays held out, of a part of the views."""
    allowed, rays, views = allowed_error(walk.settings), walk.rays, len(walk.numbers)
    rows, columns, blocks = rays.views.rows, rays.views.columns, min(_BLOCKS, views)
    double = torch.zeros((), dtype=torch.float64, device=rays.target)
    block = _blocks(views, blocks)
    weight, total = double.new_zeros((2, blocks, rows, columns))
    ends, many = torch.tensor(_DEPTHS, device=rays.target), len(_DEPTHS) + 1
    counts = double.new_zeros((len(walk), 2, 2, many))
    # The right half's depths come after the left one's, and what is not fitted after both.
    right = many * (torch.arange(columns, device=rays.target) >= columns // 2)
    held: list[list[torch.Tensor]] = [[torch.empty(0, dtype=kind) for kind in _OF_ASIDE]]
    for now, here, _, measured, fitted, aside, predicted in walk:
        left, trust = clipped(measured - predicted, fitted, allowed), fitted.square()
        # Block by block, in an order that a GPU keeps.
        for of_block in np.unique(block[now]).tolist():
            start, stop = np.searchsorted(block[now], (of_block, of_block + 1)).tolist()
            trusted, missed = trust[start:stop], left[start:stop]
            weight[of_block] += trusted.sum(dim=0, dtype=torch.float64)
            total[of_block] += (trusted * missed).sum(dim=0, dtype=torch.float64)
        depth = torch.where(trust > 0, torch.bucketize(predicted, ends) + right, 2 * many)
        depth = depth.flatten(1) + (2 * many + 1) * torch.arange(len(depth), device=depth.device)[:, None]
        for k, values in enumerate((None, left.double().flatten())):
            found = torch.bincount(depth.flatten(), values, minlength=len(measured) * (2 * many + 1))
            found = found.reshape(len(measured), -1)[:, :-1].reshape(-1, 2, many)
            counts[here, k] = found
        where = (aside > 0).nonzero(as_tuple=True)
        parts = (
            where[0] + now.start,
            where[1] * columns + where[2],
            (measured - predicted)[where],
            allowed / aside[where],
        )
        held.append([part.cpu() for part in parts])
    return [weight, total, counts, *(torch.cat(parts) for parts in zip(*held))]


def _blocks(views: int, blocks: int) -> np.ndarray:
    """In which block each view is: those beside each other in one."""
    return np.arange(views) * blocks // views
