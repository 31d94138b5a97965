"""The optimiser's loop."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from tomo_polysplat.fit.loss import total_variation, weighted_l1
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.model.seed import Seeding
from tomo_polysplat.settings import Settings

__all__ = ["FitOutcome", "fit"]

logger = logging.getLogger(__name__)


@dataclass
class FitOutcome:
    """Fitted Gaussians with the record of the run."""

    gaussians: Gaussians
    history: list[dict[str, Any]] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    reason: str = ""


def fit(
    gaussians: Gaussians,
    seeding: Seeding,
    rays: Rays,
    scene: FitScene,
    settings: Settings,
    seed: int,
    time_budget: float | None = None,
    monitor=None,
) -> FitOutcome:
    """Fit Gaussians to rays."""
    started = time.perf_counter()
    rng = np.random.default_rng(seed)
    parameters = gaussians.tensors()
    rates = {
        "position": settings.learning_rate_position * seeding.spacing,
        "log_scale": settings.learning_rate_scale,
        "rotation": settings.learning_rate_rotation,
        "density": settings.learning_rate_density,
        "material": settings.learning_rate_material,
    }
    for tensor in parameters.values():
        tensor.requires_grad_()
    optimiser = torch.optim.Adam(
        [{"params": [parameters[name]], "lr": rate, "rate": rate} for name, rate in rates.items()], eps=1e-15, fused=True
    )
    voxel = float(scene.box.spacing[: 2 if gaussians.planar else 3].min())
    low, high = math.log(settings.smallest_scale * voxel), math.log(settings.largest_scale * seeding.spacing)
    frozen = torch.as_tensor(~seeding.material_free, device=gaussians.position.device)
    count = len(rays.views)
    batch = min(settings.views_per_step, count)
    steps = max(1, math.ceil(settings.passes * count / batch))
    outcome = FitOutcome(gaussians)
    order = np.empty(0, int)
    check_every = max(1, count // batch)
    running = [0.0, 0.0, 0]
    for step in range(steps):
        elapsed = time.perf_counter() - started
        progress = step / steps if time_budget is None else max(step / steps, elapsed / time_budget)
        if progress >= 1:
            break
        for group in optimiser.param_groups:
            group["lr"] = group["rate"] * settings.final_rate**progress
        if len(order) < batch:
            order = np.concatenate([order, rng.permutation(count)])
        chosen, order = order[:batch], order[batch:]
        views, measured, weight, aside = rays.batch(chosen)
        predicted, skipped = scene.projections(gaussians, views)
        misfit = weighted_l1(predicted, measured, weight)
        loss = misfit
        if settings.tv_weight:
            loss = loss + settings.tv_weight * _roughness(gaussians, scene, settings, rng)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        if scene.polychromatic:
            gaussians.material.grad[frozen] = 0.0
        optimiser.step()
        with torch.no_grad():
            gaussians.density.clamp_(min=0.0)
            gaussians.material.clamp_(0.0, 1.0)
            gaussians.log_scale.clamp_(low, high)
            running[0] += float(misfit)
            running[1] += float(weighted_l1(predicted, measured, aside))
            running[2] += 1
        if (step + 1) % check_every == 0:
            entry = {
                "seconds": time.perf_counter() - started,
                "iteration": step + 1,
                "loss": running[0] / running[2],
                "held_out": running[1] / running[2],
                "gaussians": len(gaussians),
            }
            running = [0.0, 0.0, 0]
            outcome.history.append(entry)
            if monitor is not None:
                monitor(entry, gaussians)
    return outcome


def _roughness(gaussians: Gaussians, scene: FitScene, settings: Settings, rng: np.random.Generator) -> torch.Tensor:
    """Total variation in a random box."""
    shape = tuple(min(settings.tv_box, n) for n in scene.box.shape)
    start = tuple(int(rng.integers(0, n - m + 1)) for n, m in zip(scene.box.shape, shape))
    box = scene.box.part(start, shape)
    lower = torch.as_tensor(box.first, dtype=torch.float32, device=gaussians.position.device)
    upper = lower + torch.as_tensor((np.array(shape[::-1]) - 1) * box.spacing, dtype=torch.float32, device=lower.device)
    with torch.no_grad():
        reach = 3.4 * gaussians.log_scale.max(dim=1).values.exp()[:, None]
        near = ((gaussians.position + reach >= lower) & (gaussians.position - reach <= upper)).all(dim=1)
        index = near.nonzero()[:, 0]
    return total_variation(scene.attenuation(gaussians.select(index), box), settings.tv_clip)
