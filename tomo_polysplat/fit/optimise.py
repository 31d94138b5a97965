"""The optimiser's loop."""

from __future__ import annotations

import copy
import itertools
import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from tomo_polysplat.fit.checkpoint import Checkpoint, Snapshot
from tomo_polysplat.fit.choose_step import make_step
from tomo_polysplat.fit.learning_rates import hurried
from tomo_polysplat.fit.metal_numbers import number_metals
from tomo_polysplat.fit.pixel_question import PixelQuestion
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.soft_matter import flatten
from tomo_polysplat.fit.stopping import Clock, FitState, Watch, patience_of
from tomo_polysplat.kernels.spatial_order import spatial_order
from tomo_polysplat.model.density_control import relocate
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings

__all__ = ["FitOutcome", "FitState", "fit"]

logger = logging.getLogger(__name__)

# A pass over fewer views than this makes the steps of one over as many.
_FEWEST_VIEWS = 10


@dataclass
class FitOutcome:
    """Fitted Gaussians with the record of the run."""

    gaussians: Gaussians
    history: list[dict[str, Any]] = field(default_factory=list)
    skipped_pairs: int = 0
    relocated: int = 0
    reason: str = ""

    def counts(self) -> dict[str, int]:
        """What was skipped or held at a bound."""
        return {
            "gaussians": len(self.gaussians),
            "gaussians_at_zero": int((self.gaussians.attenuation <= 0).sum()),
            "gaussians_relocated": self.relocated,
            "pairs_skipped_at_source": self.skipped_pairs,
        }


class _Fitter:
    """One run: its steps, the order of the views, and the moves of Gaussians between passes."""

    def __init__(
        self,
        gaussians: Gaussians,
        spacing: float,
        rays: Rays,
        scene: FitScene,
        settings: Settings,
        batch: int,
        rng: np.random.Generator,
    ) -> None:
        self.gaussians, self.rays, self.scene, self.settings, self.rng = gaussians, rays, scene, settings, rng
        self.step = make_step(gaussians, spacing, rays, scene, settings, batch=batch)
        self.spacing, self.batch, self.order = spacing, batch, np.empty(0, int)
        self.relocated = 0
        self.relocation_due = False

    def passes(self, clock: Clock) -> Iterator[tuple[float, float, int]]:
        """Step until the clock runs out; what each pass over the views gave, the last perhaps a part of one.

        That is the mean misfit of the fitted rays and of those held out, and the pairs skipped.
        """
        steps, made = max(1, round(_views_of_a_pass(self.rays) / self.batch)), 0
        while (share := clock.share()) < 1:
            if self.relocation_due:
                self._relocate()
            views = self._next_views(self.batch)
            self.step(views, share)
            clock.done += 1
            made += 1
            if made == steps:
                self.relocation_due = share < self.settings.relocate_until
                yield self._end_pass(share)
                made = 0
        if made:
            yield self._end_pass(1.0)

    def ahead(self, clock: Clock, passes: int) -> list[tuple[float, float, int]]:
        """What so many more passes gave, as `passes` tells it."""
        return list(itertools.islice(self.passes(clock), passes))

    def branch(self, pixel_rays: int) -> _Fitter:
        """The same run from here on, with so many rays a pixel and axis, on Gaussians of its own."""
        scene, rng = replace(self.scene, pixel_rays=pixel_rays), copy.deepcopy(self.rng)
        other = _Fitter(self.gaussians.copy(), self.spacing, self.rays, scene, self.settings, self.batch, rng)
        other.restore(self.snapshot(None, {}))
        return other

    @torch.no_grad()
    def _end_pass(self, share: float) -> tuple[float, float, int]:
        # Once a pass does: in its few steps a Gaussian does not get far beyond the volume.
        self.scene.keep_within(self.gaussians)
        # What is not finite any more is nowhere to look at, and `Watch` ends the run.
        if self.gaussians.finite():
            flatten(self.gaussians, self.scene, self.settings, share)
            number_metals(self.gaussians, self.scene, self.settings, share)
        return self.step.read()

    def snapshot(self, best: Gaussians | None, numbers: dict[str, Any]) -> Snapshot:
        """Where the fit stands between two passes; ``numbers`` of the run are kept with it."""
        own = {
            "steps_made": self.step.done,
            "largest": self.step.largest,
            "relocated": self.relocated,
            "relocation_due": self.relocation_due,
            "random": self.rng.bit_generator.state,
        }
        first, second = ({k: pair[j] for k, pair in self.step.moments.items()} for j in (0, 1))
        return Snapshot(self.gaussians, best, first, second, self.step.pull, self.order, own | numbers)

    @torch.no_grad()
    def restore(self, kept: Snapshot) -> None:
        """Go on from a snapshot, with whose Gaussians this was made."""
        for name, (first, second) in self.step.moments.items():
            first.copy_(kept.first[name])
            second.copy_(kept.second[name])
        self.step.pull.copy_(kept.pull)
        self.order = kept.order
        self.step.done = int(kept.numbers["steps_made"])
        self.step.largest = kept.numbers["largest"]
        self.relocated = int(kept.numbers["relocated"])
        self.relocation_due = bool(kept.numbers["relocation_due"])
        self.rng.bit_generator.state = kept.numbers["random"]

    @torch.no_grad()
    def _relocate(self) -> None:
        """Put Gaussians that hold nothing where they are wanted, with a fresh memory of the optimiser."""
        self.relocation_due = False
        changed = relocate(self.gaussians, self.step.pull, self.settings.relocated)
        self.step.pull.zero_()
        if not len(changed):
            return
        self.relocated += len(changed) // 2
        own = self.gaussians.each()
        memory = [moment for name in own for moment in self.step.moments.get(name, ())]
        for moment in memory:
            moment[changed] = 0.0
        # What was moved stands where the dead were in the list: groups of it would reach across the volume, which
        # makes the kernels' images several times slower.
        order = spatial_order(self.gaussians.position)
        for tensor in (*own.values(), *memory):
            tensor.copy_(tensor[order])

    def _next_views(self, batch: int) -> np.ndarray:
        """The next views of an order that uses each once before any again."""
        while len(self.order) < batch:
            self.order = np.concatenate([self.order, self.rng.permutation(len(self.rays.views))])
        chosen, self.order = self.order[:batch], self.order[batch:]
        return chosen


@dataclass
class _Run:
    """All that changes during a run, and the file that keeps it, if there is one."""

    fitter: _Fitter
    outcome: FitOutcome
    watch: Watch[Gaussians]
    clock: Clock
    started: float
    checkpoint: Checkpoint | None
    question: PixelQuestion | None

    def keep(self, *, now: bool) -> None:
        """Offer the checkpoint the state between two passes."""
        if self.checkpoint is not None:
            self.checkpoint.offer(lambda: self.fitter.snapshot(self.watch.best, self._numbers()), now=now)

    def _numbers(self) -> dict[str, Any]:
        outcome, clock = self.outcome, self.clock
        return {
            "steps": clock.done,
            "seconds": time.perf_counter() - self.started,
            "begun": clock.begun - self.started,
            "history": outcome.history,
            "skipped_pairs": outcome.skipped_pairs,
            "reason": outcome.reason,
        }

    def restore(self) -> None:
        """Go on from the checkpoint's snapshot, where there is one."""
        if self.checkpoint is None or self.checkpoint.snapshot is None:
            return
        kept, self.checkpoint.snapshot = self.checkpoint.snapshot, None
        numbers, gaussians = kept.numbers, self.fitter.gaussians
        self.fitter.restore(kept)
        self.clock.done, self.clock.begun = numbers["steps"], self.started + numbers["begun"]
        best = None if kept.best is None else kept.best.to(gaussians.position.device)
        self.watch.recall(numbers["history"], best)
        self.outcome.history, self.outcome.reason = numbers["history"], numbers["reason"]
        self.outcome.skipped_pairs = numbers["skipped_pairs"]
        self.outcome.relocated = self.fitter.relocated

    def follow(
        self, volume: Callable[[Gaussians], np.ndarray], callbacks: Sequence[Callable[[FitState], Any]]
    ) -> None:
        """Pass by pass until something ends the run, which the outcome's reason then says."""
        outcome = self.outcome
        for loss, held_out, skipped in self._passes():
            outcome.skipped_pairs += skipped
            outcome.relocated = self.fitter.relocated
            state = self._state(loss, held_out, volume)
            outcome.history.append(state.record())
            outcome.reason = self.watch.judge(state, self.fitter.gaussians)
            self.keep(now=bool(outcome.reason) or self.clock.share() >= 1)
            if any([_is_true(callback(state)) for callback in callbacks]):
                self.keep(now=True)
                outcome.reason = "a callback ended it"
            if outcome.reason:
                return

    def _passes(self) -> Iterator[tuple[float, float, int]]:
        """What each pass gave; where the question is asked, two at once, so that no checkpoint lies between them."""
        passes = self.fitter.passes(self.clock)
        while True:
            if self.question is not None and self.question.due(self.clock):
                self.fitter, made = self.question.answered(self.fitter, self.clock)
                passes = self.fitter.passes(self.clock)
                if made is not None:
                    yield made
            elif (one := next(passes, None)) is not None:
                yield one
            else:
                return

    def _state(self, loss: float, held_out: float, volume: Callable[[Gaussians], np.ndarray]) -> FitState:
        gaussians, clock = self.fitter.gaussians, self.clock
        seconds = time.perf_counter() - self.started
        numbers = (seconds, clock.done, len(gaussians), loss, held_out, clock.share())
        return FitState(*numbers, lambda: volume(gaussians))


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
    checkpoint: Checkpoint | None = None,
    question: PixelQuestion | None = None,
) -> FitOutcome:
    """Fit Gaussians to rays.

    Stops after ``settings.passes`` over the views, at ``deadline`` (``time.perf_counter`` seconds), when the
    held-out rays have not improved for `patience_of` passes, when a callback returns True, or on
    KeyboardInterrupt; returns the Gaussians that `Watch` holds for the best. Where ``checkpoint``
    holds a snapshot, ``gaussians`` are its own and the fit goes on from there. ``question`` is asked on the way.
    """
    if not len(gaussians):
        logger.warning("The start volume is empty: no Gaussians, a volume of zeros.")
        return FitOutcome(gaussians, reason="nothing to fit: the start volume is empty")
    batch = min(views_per_step, len(rays.views))
    steps = max(1, math.ceil(settings.passes * _views_of_a_pass(rays) / batch))
    fitter = _Fitter(gaussians, spacing, rays, scene, hurried(settings, steps), batch, rng)
    # From now on: what compiling or recording the step took is no part of the run that the learning rates follow.
    clock = Clock(steps, deadline)
    outcome = FitOutcome(gaussians)
    watch: Watch[Gaussians] = Watch(patience_of(settings, settings.passes))
    run = _Run(fitter, outcome, watch, clock, started, checkpoint, question)
    run.restore()
    try:
        if not outcome.reason:
            run.follow(volume, callbacks)
    except KeyboardInterrupt:
        logger.warning("Interrupted after %d steps; the best state so far is returned.", clock.done)
        outcome.reason = "interrupted"
    outcome.reason = outcome.reason or _used_up(clock, settings)
    outcome.gaussians = watch.best or gaussians.copy()
    return outcome


def _used_up(clock: Clock, settings: Settings) -> str:
    """Why a run ended that nothing else had ended before."""
    if not clock.late:
        return f"{settings.passes:g} passes over the views were made"
    if clock.done:
        return "the time budget was used"
    logger.warning("The time budget ended before the first step: the result is no better than its start.")
    return "the time budget was used before the first step"


def _views_of_a_pass(rays: Rays) -> int:
    return max(len(rays.views), _FEWEST_VIEWS)


def _is_true(answer: Any) -> bool:
    """Whether a callback said True; whatever else a function happens to return is no answer."""
    return isinstance(answer, (bool, np.bool_)) and bool(answer)
