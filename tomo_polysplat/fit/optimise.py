"""The optimiser's loop."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from tomo_polysplat.fit.loss import misfit, roughness
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.similarity import dissimilarity
from tomo_polysplat.fit.stopping import Clock, FitState, Watch
from tomo_polysplat.model.density_control import relocate
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings

__all__ = ["FitOutcome", "FitState", "fit"]

logger = logging.getLogger(__name__)

# Fat and plastics harden a beam less than water does: their curve is the mixture's continued a little below 0.
LEAST_U = -0.1
# Fewer held-out rays in a pass, counted by weight, go up and down by chance.
_FEWEST_HELD_OUT = 10.0


@dataclass
class FitOutcome:
    """Fitted Gaussians with the record of the run."""

    gaussians: Gaussians
    history: list[dict[str, Any]] = field(default_factory=list)
    skipped_pairs: int = 0
    relocated: int = 0
    reason: str = ""


@dataclass
class _Pass:
    """Sums over the steps of a pass; tensors until they are asked for, so that no step waits for a GPU."""

    steps: list[tuple[torch.Tensor, torch.Tensor, torch.Tensor, int | torch.Tensor]] = field(
        default_factory=list
    )

    def read(self) -> tuple[float, float, int]:
        """Mean misfit of the fitted rays and of the held-out ones, and the number of pairs skipped."""
        fitted, held_out, weight, skipped = (float(sum(values)) for values in zip(*self.steps))
        return (
            fitted / len(self.steps),
            held_out / weight if weight >= _FEWEST_HELD_OUT else math.nan,
            round(skipped),
        )


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
        self.pull = torch.zeros_like(gaussians.attenuation)
        self.relocated = 0

    def passes(self, batch: int, clock: Clock) -> Iterator[_Pass]:
        """Step until the clock runs out; what each pass over the views gave, the last perhaps a part of one."""
        steps = max(1, round(len(self.rays.views) / batch))
        record = _Pass()
        while (share := clock.share()) < 1:
            record.steps.append(self.step(share, batch))
            clock.done += 1
            if len(record.steps) == steps:
                yield record
                record = _Pass()
                if share < self.settings.relocate_until:
                    self._relocate()
        if record.steps:
            yield record

    def step(
        self, share: float, batch: int
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, int | torch.Tensor]:
        """One step of the optimiser.

        Returns the mean misfit of the fitted rays, the sum of that of the held-out rays, their weight, and
        the pairs skipped.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = group["rate"] * self.settings.final_rate**share
        views, measured, weight, aside = self.rays.batch(self._next_views(batch))
        predicted, skipped = self.scene.projections(self.gaussians, views)
        fitted = misfit(predicted, measured, weight, self.settings)
        loss = fitted + self._regularisation(predicted, measured, weight)
        self.optimiser.zero_grad(set_to_none=True)
        # On this thread: autograd's own would be woken and waited for at every step.
        with torch.autograd.set_multithreading_enabled(False):
            loss.backward()
        self._hold_materials(share)
        if (moved := self.gaussians.position.grad) is not None:
            self.pull += moved.norm(dim=1)
        self.optimiser.step()
        with torch.no_grad():
            self.gaussians.attenuation.clamp_(min=0.0)
            self.gaussians.own_material.clamp_(LEAST_U, 1.0)
            self.gaussians.shared_material.clamp_(LEAST_U, 1.0)
            self.gaussians.log_scale.clamp_(*self.bounds)
            weight = aside.sum()
            return (
                fitted.detach(),
                misfit(predicted, measured, aside, self.settings) * weight,
                weight,
                skipped,
            )

    def _regularisation(
        self, predicted: torch.Tensor, measured: torch.Tensor, weight: torch.Tensor
    ) -> torch.Tensor | float:
        """What is added to the misfit: total variation, and the dissimilarity of the projections if asked for."""
        settings = self.settings
        total: torch.Tensor | float = 0.0
        if settings.tv_weight:
            total = total + settings.tv_weight * roughness(self.gaussians, self.scene, settings, self.rng)
        if settings.ssim_weight:
            total = total + settings.ssim_weight * dissimilarity(predicted, measured, weight)
        return total

    def _relocate(self) -> None:
        """Put Gaussians that hold nothing where they are wanted, with a fresh memory of the optimiser."""
        changed = relocate(self.gaussians, self.pull, self.settings.relocated)
        self.pull.zero_()
        if len(changed):
            self.relocated += len(changed) // 2
            for name, tensor in self.gaussians.parameters().items():
                # A parameter that the model does not use has no memory.
                memory = {} if name == "shared_material" else self.optimiser.state.get(tensor, {})
                for moment in ("exp_avg", "exp_avg_sq"):
                    if moment in memory:
                        memory[moment][changed] = 0.0

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
    outcome, watch = FitOutcome(gaussians), Watch(settings)
    batch = min(views_per_step, len(rays.views))
    clock = Clock(max(1, math.ceil(settings.passes * len(rays.views) / batch)), deadline)
    try:
        for record in fitter.passes(batch, clock):
            loss, held_out, skipped = record.read()
            outcome.skipped_pairs += skipped
            outcome.relocated = fitter.relocated
            state = FitState(
                time.perf_counter() - started,
                clock.done,
                len(gaussians),
                loss,
                held_out,
                clock.share(),
                lambda: volume(gaussians),
            )
            outcome.history.append(state.record())
            outcome.reason = watch.judge(state, gaussians)
            if any([_is_true(callback(state)) for callback in callbacks]):
                outcome.reason = "a callback ended it"
            if outcome.reason:
                break
    except KeyboardInterrupt:
        logger.warning("Interrupted after %d steps; the best state so far is returned.", clock.done)
        outcome.reason = "interrupted"
    used_up = (
        "the time budget was used" if clock.late else f"{settings.passes:g} passes over the views were made"
    )
    outcome.reason = outcome.reason or used_up
    outcome.gaussians = watch.best or gaussians.copy()
    return outcome


def _is_true(answer: Any) -> bool:
    """Whether a callback said True; whatever else a function happens to return is no answer."""
    return isinstance(answer, (bool, np.bool_)) and bool(answer)
