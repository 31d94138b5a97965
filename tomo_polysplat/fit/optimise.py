"""The optimiser's loop."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from tomo_polysplat.fit.loss import misfit, roughness
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings

__all__ = ["FitOutcome", "FitState", "fit"]

logger = logging.getLogger(__name__)

# Fat and plastics harden a beam less than water does: their curve is the mixture's continued a little below 0.
LEAST_U = -0.1
# A held-out error that falls by less than this share in a pass over the views has stopped falling.
_IMPROVEMENT = 2e-3


@dataclass
class FitState:
    """What a callback sees, once a pass over the views.

    Attributes
    ----------
    seconds : float
        Since the reconstruction began.
    iteration, gaussians : int
    loss, held_out : float
        Mean misfit of the fitted and of the held-out rays over the pass.
    share : float
        Of the run that is done, 0 to 1.
    volume : callable
        Returns the current volume in 1/unit, shaped like that of the result.
    """

    seconds: float
    iteration: int
    gaussians: int
    loss: float
    held_out: float
    share: float
    volume: Callable[[], np.ndarray]

    def record(self) -> dict[str, Any]:
        """The numbers, for the history."""
        names = ("seconds", "iteration", "loss", "held_out", "gaussians")
        return {name: getattr(self, name) for name in names} | {"stage": "fit"}


@dataclass
class FitOutcome:
    """Fitted Gaussians with the record of the run."""

    gaussians: Gaussians
    history: list[dict[str, Any]] = field(default_factory=list)
    skipped_pairs: int = 0
    reason: str = ""


class _Fitter:
    """One run: parameters, optimiser, order of the views."""

    def __init__(
        self,
        gaussians: Gaussians,
        spacing: float,
        rays: Rays,
        scene: FitScene,
        settings: Settings,
        rng: np.random.Generator,
    ) -> None:
        self.gaussians, self.rays, self.scene, self.settings, self.rng = gaussians, rays, scene, settings, rng
        rates = {
            "position": settings.learning_rate_position * spacing,
            "log_scale": settings.learning_rate_scale,
            "rotation": settings.learning_rate_rotation,
            "attenuation": settings.learning_rate_attenuation,
            "own_material": settings.learning_rate_material,
            "shared_material": settings.learning_rate_shared,
        }
        parameters = gaussians.parameters()
        groups = [{"params": [parameters[k].requires_grad_()], "lr": v, "rate": v} for k, v in rates.items()]
        self.optimiser = torch.optim.Adam(groups, eps=1e-15, fused=True)
        voxel = float(scene.box.spacing[: 2 if gaussians.planar else 3].min())
        self.bounds = (
            math.log(settings.smallest_scale * voxel),
            math.log(settings.largest_scale * spacing),
        )
        self.order = np.empty(0, int)

    def step(self, share: float, batch: int) -> tuple[torch.Tensor, torch.Tensor, int | torch.Tensor]:
        """One step of the optimiser; misfit of the fitted and the held-out rays, and pairs skipped."""
        for group in self.optimiser.param_groups:
            group["lr"] = group["rate"] * self.settings.final_rate**share
        views, measured, weight, aside = self.rays.batch(self._next_views(batch))
        predicted, skipped = self.scene.projections(self.gaussians, views)
        fitted = misfit(predicted, measured, weight, self.settings)
        loss = fitted
        if self.settings.tv_weight:
            loss = loss + self.settings.tv_weight * roughness(
                self.gaussians, self.scene, self.settings, self.rng
            )
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self._hold_materials(share)
        self.optimiser.step()
        with torch.no_grad():
            self.gaussians.attenuation.clamp_(min=0.0)
            self.gaussians.own_material.clamp_(LEAST_U, 1.0)
            self.gaussians.shared_material.clamp_(LEAST_U, 1.0)
            self.gaussians.log_scale.clamp_(*self.bounds)
            return fitted.detach(), misfit(predicted, measured, aside, self.settings), skipped

    def _hold_materials(self, share: float) -> None:
        """Keep the soft matter's number, and for a while the metals': while edges are blurred they would drift.

        A little cupping and a little hardening look alike, so a soft number that is free trades one for the
        other; held at the first curve the two stay apart.
        """
        gradient = self.gaussians.shared_material.grad
        if gradient is not None:
            gradient[: 1 if share >= self.settings.material_from else None] = 0.0

    def _next_views(self, batch: int) -> np.ndarray:
        """The next views of an order that uses each once before any again."""
        while len(self.order) < batch:
            self.order = np.concatenate([self.order, self.rng.permutation(len(self.rays.views))])
        chosen, self.order = self.order[:batch], self.order[batch:]
        return chosen


def fit(
    gaussians: Gaussians,
    spacing: float,
    rays: Rays,
    scene: FitScene,
    settings: Settings,
    *,
    views_per_step: int,
    rng: np.random.Generator,
    started: float,
    deadline: float | None = None,
    volume: Callable[[Gaussians], np.ndarray],
    callbacks: Sequence[Callable[[FitState], Any]] = (),
) -> FitOutcome:
    """Fit Gaussians to rays.

    Stops after ``settings.passes`` over the views, at ``deadline`` (``time.perf_counter`` seconds), when the
    held-out rays have not improved for ``settings.patience`` passes, when a callback returns True, or on
    KeyboardInterrupt; returns the Gaussians of the pass whose held-out rays fitted best.
    """
    if not len(gaussians):
        logger.warning("The start volume is empty: no Gaussians, a volume of zeros.")
        return FitOutcome(gaussians, reason="nothing to fit: the start volume is empty")
    fitter = _Fitter(gaussians, spacing, rays, scene, settings, rng)
    count = len(rays.views)
    batch = min(views_per_step, count)
    per_pass = max(1, round(count / batch))
    steps = max(1, math.ceil(settings.passes * count / batch))
    outcome = FitOutcome(gaussians.copy())
    begun = time.perf_counter()
    watch = _Watch(settings)
    sums: list[tuple] = []
    try:
        for step in range(steps):
            share = step / steps
            if deadline is not None:
                share = max(share, (time.perf_counter() - begun) / max(deadline - begun, 1e-9))
            if share >= 1:
                outcome.reason = "the time budget was used"
                break
            sums.append(fitter.step(share, batch))
            if len(sums) < per_pass and step + 1 < steps:
                continue
            loss, held_out, skipped = (float(sum(values)) / len(sums) for values in zip(*sums))
            outcome.skipped_pairs += round(skipped * len(sums))
            sums = []
            state = FitState(
                time.perf_counter() - started,
                step + 1,
                len(gaussians),
                loss,
                held_out,
                share,
                lambda: volume(gaussians),
            )
            outcome.history.append(state.record())
            outcome.reason = watch.judge(state, gaussians)
            if any([callback(state) is True for callback in callbacks]):
                outcome.reason = "a callback ended it"
            if outcome.reason:
                break
    except KeyboardInterrupt:
        logger.warning("Interrupted after %d steps; the best state so far is returned.", step)
        outcome.reason = "interrupted"
    outcome.reason = outcome.reason or f"{settings.passes:g} passes over the views were made"
    outcome.gaussians = watch.best or gaussians.copy()
    return outcome


class _Watch:
    """Keeps the best state and says when to stop."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.best: Gaussians | None = None
        self.lowest = math.inf
        self.waited = 0

    def judge(self, state: FitState, gaussians: Gaussians) -> str:
        """The reason to stop, or nothing."""
        if not math.isfinite(state.loss):
            if self.best is None:
                raise FloatingPointError(
                    "the fit diverged in its first pass; see the log for rays out of range"
                )
            return "the misfit stopped being finite"
        score = state.held_out if self.settings.held_out else state.loss
        self.waited = 0 if score < (1 - _IMPROVEMENT) * self.lowest else self.waited + 1
        if score <= self.lowest:
            self.lowest, self.best = score, gaussians.copy()
        if self.settings.held_out and self.waited >= self.settings.patience:
            return f"the held-out rays had not improved for {self.waited} passes"
        return ""
