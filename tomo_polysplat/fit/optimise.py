"""The optimiser's loop."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tomo_polysplat.fit.loss import random_box
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.step import EagerStep, Step
from tomo_polysplat.fit.stopping import Clock, FitState, Watch
from tomo_polysplat.model.density_control import relocate
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings

__all__ = ["FitOutcome", "FitState", "fit"]

logger = logging.getLogger(__name__)


@dataclass
class FitOutcome:
    """Fitted Gaussians with the record of the run."""

    gaussians: Gaussians
    history: list[dict[str, Any]] = field(default_factory=list)
    skipped_pairs: int = 0
    relocated: int = 0
    reason: str = ""


class _Fitter:
    """One run: its steps, the order of the views, and the moves of Gaussians between passes."""

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
        self.step: Step = EagerStep(gaussians, spacing, rays, scene, settings)
        self.order = np.empty(0, int)
        self.relocated = 0

    def passes(self, batch: int, clock: Clock) -> Iterator[tuple[float, float, int]]:
        """Step until the clock runs out; what each pass over the views gave, the last perhaps a part of one.

        That is the mean misfit of the fitted rays and of those held out, and the pairs skipped.
        """
        steps, made = max(1, round(len(self.rays.views) / batch)), 0
        while (share := clock.share()) < 1:
            views = self._next_views(batch)
            self.step(views, random_box(self.scene.box, self.settings, self.rng), share)
            clock.done += 1
            made += 1
            if made == steps:
                yield self.step.read()
                made = 0
                if share < self.settings.relocate_until:
                    self._relocate()
        if made:
            yield self.step.read()

    def _relocate(self) -> None:
        """Put Gaussians that hold nothing where they are wanted, with a fresh memory of the optimiser."""
        changed = relocate(self.gaussians, self.step.pull, self.settings.relocated)
        self.step.pull.zero_()
        if len(changed):
            self.relocated += len(changed) // 2
            for name, moments in self.step.moments.items():
                if name != "shared_material":
                    for moment in moments:
                        moment[changed] = 0.0

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
            loss, held_out, skipped = record
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
