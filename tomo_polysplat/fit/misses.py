"""By how much a state of a fit misses rays, in units of their noise: of those held out, where these are enough."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from tomo_polysplat.fit.loss import misfit
from tomo_polysplat.fit.rays import Rays, batches_around
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.scan.noise import RayNoise
from tomo_polysplat.settings import Settings

__all__ = ["Misses", "misses"]

# Rays that tell it to a few per cent, and views looked at for them at least.
_ENOUGH, _VIEWS = 1000, 24
# Where fewer are held out, the fitted ones are taken.
_FEWEST = 20


@dataclass(frozen=True)
class Misses:
    """How rays are missed.

    Attributes
    ----------
    misfit, least : float
        Mean of what the fit minimises, and what noise alone would leave of it.
    times : float
        Root mean square residual over the rays' noise; infinity for a scan that shows none.
    allowed : float
        The same over the noise and the error that the model is allowed (``settings.model_error``).
    rays : int
    held_out : bool
        Whether the fit has not seen them.
    """

    misfit: float
    least: float
    times: float
    allowed: float
    rays: int
    held_out: bool

    @property
    def excess(self) -> float:
        """Misfit that noise does not explain."""
        return max(self.misfit - self.least, 0.0)

    def describe(self) -> str:
        """Words after "the rays"."""
        kept = "rays kept out of the fit" if self.held_out else "rays of the fit"
        if math.isinf(self.times):
            return f"{kept} are missed by {self.allowed:.2g} times the error that the model is allowed"
        return f"{kept} are missed by {self.times:.2g} times their noise"


@torch.no_grad()
def misses(gaussians: Gaussians, scene: FitScene, rays: Rays, noise: RayNoise, settings: Settings) -> Misses:
    """How Gaussians miss the rays of some views, evenly spread over the scan.

    Parameters
    ----------
    gaussians : Gaussians
    scene : FitScene
    rays : Rays
    noise : RayNoise
    settings : Settings
        For the misfit, and the model's error.
    """
    held_out = rays.held_out * len(rays.views) * _pixels(rays) >= _FEWEST
    seen = []
    for views, measured, fitted, aside in batches_around(rays, _views(rays)):
        predicted, _ = scene.projections(gaussians, views)
        weight = aside if held_out else fitted
        seen.append([part[weight > 0].cpu() for part in (predicted, measured, weight)])
    predicted, measured, weight = (torch.cat(parts) for parts in zip(*seen))
    variance = noise.variance(measured)
    drawn = torch.from_numpy(np.random.default_rng(0).standard_normal(len(measured), np.float32))
    noisy = measured + drawn.to(measured) * variance.sqrt()
    squares = (predicted - measured).double().square()
    return Misses(
        float(misfit(predicted, measured, weight, settings)),
        float(misfit(noisy, measured, weight, settings)),
        _root(squares / variance) if noise.shows else math.inf,
        # Noise that is as strong in every ray is a part of the model's error already.
        _root(squares / (variance + max(settings.model_error**2 - noise.deviation**2, 0.0))),
        len(measured),
        held_out,
    )


def _pixels(rays: Rays) -> int:
    return rays.views.rows * rays.views.columns


def _views(rays: Rays) -> int:
    """How many views hold enough rays of those held out."""
    a_view = max(rays.held_out, 1e-6) * _pixels(rays)
    return max(_VIEWS, math.ceil(_ENOUGH / a_view))


def _root(squares: torch.Tensor) -> float:
    return math.sqrt(float(squares.mean())) if len(squares) else 0.0
