"""Some rays of a fit, with what it explains them by."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from tomo_polysplat.fit.rays import Rays, batches_around, views_around
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.physics.ray_estimates import FittedRays
from tomo_polysplat.physics.scatter import Scatter, light_around
from tomo_polysplat.render.renderer import project_gaussians

__all__ = ["RaySample", "sample_rays"]

_RAYS = 60_000
# Rays that see no more than this share of what the densest one sees pass beside the object.
_HAZE = 1e-3
# A ray is darker where it has less than this share of the light that it should have, and less by this many deviations.
_LESS, _DEVIATIONS = 0.85, 3.0
# As few rays beside the object do not tell how bright the beam is.
_FEWEST_BESIDE = 100
# Deviation of a median of n normal values, times sqrt(n).
_OF_A_MEDIAN = math.sqrt(math.pi / 2)


@dataclass(frozen=True)
class RaySample:
    """Some rays of a fit.

    Attributes
    ----------
    areal : (curves, rays) array
        Areal densities in g/cm2.
    measured, weight : (rays,) arrays
        Their P, and the inverse of its deviation, 1 for a ray without noise.
    light : (rays,) array
        That around them; see `tomo_polysplat.physics.scatter.light_around`.
    view : (rays,) array
        Which of the views looked at they belong to.
    deviation : (rays,) array
        Of their noise.
    """

    areal: np.ndarray
    measured: np.ndarray
    weight: np.ndarray
    light: np.ndarray
    view: np.ndarray
    deviation: np.ndarray

    @property
    def fitted(self) -> FittedRays:
        """What scatter is estimated from."""
        return FittedRays(self.areal, self.measured, self.weight, self.light)

    @property
    def beside(self) -> np.ndarray:
        """Which of them pass beside the object, but for a haze."""
        seen = self.areal.sum(axis=0)
        return seen <= _HAZE * seen.max(initial=0.0)

    def beam(self) -> float:
        """How many times as bright as the open field the rays beside the object are; 1 where there are too few."""
        values = self.measured[self.beside]
        return float(np.exp(-np.median(values))) if len(values) >= _FEWEST_BESIDE else 1.0

    def beam_error(self) -> float:
        """Deviation of `beam` by the noise of these rays; 0 where there are too few."""
        noise = self.deviation[self.beside]
        if len(noise) < _FEWEST_BESIDE:
            return 0.0
        return _OF_A_MEDIAN * float(np.sqrt(np.mean(noise**2) / len(noise)))

    def darker_than(self, scatter: Scatter) -> int:
        """How many rays have less light than their scatter alone, whatever their noise."""
        least = scatter.at(torch.as_tensor(self.light)).numpy()
        return int(np.count_nonzero(np.exp(_DEVIATIONS * self.deviation - self.measured) < _LESS * least))


@torch.no_grad()
def sample_rays(gaussians: Gaussians, scene: FitScene, rays: Rays, seed: int, most: int = _RAYS) -> RaySample:
    """So many of the rays at most, of views all around."""
    parts: list[list[np.ndarray]] = []
    weights, rng = gaussians.weights(scene.reference_curve), np.random.default_rng(seed)
    seen, views_in_all = 0, views_around(rays)
    for views, measured, weight, aside in batches_around(rays):
        areal, _ = project_gaussians(gaussians, weights, views, scene.kernel)
        weight = weight + aside
        areal = areal * scene.areal_scale
        whole_beam = measured if rays.dimmed is None else measured + rays.dimmed
        measured = scene.as_if_bare(areal, measured)
        light = light_around(torch.where(weight > 0, whole_beam, torch.nan))
        used = (weight.reshape(-1) > 0).nonzero()[:, 0]
        many = min(len(used), -(-most * len(measured) // views_in_all))
        chosen = used[torch.from_numpy(rng.choice(len(used), many, replace=False)).to(used.device)]
        view, seen = seen + chosen // measured[0].numel(), seen + len(measured)
        flat = [areal.reshape(len(areal), -1)[:, chosen]]
        flat += [values.reshape(-1)[chosen] for values in (measured, weight, light)]
        parts.append([tensor.double().cpu().numpy() for tensor in (*flat, view)])
    whole = [np.concatenate(part, axis=-1) for part in zip(*parts)]
    deviation = np.sqrt(rays.variance(whole[1]))
    return RaySample(whole[0], whole[1], whole[2], whole[3], whole[4], deviation)
