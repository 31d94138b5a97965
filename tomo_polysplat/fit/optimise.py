"""A fit: pass by pass until something ends it, and what it keeps."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tomo_polysplat.fit.checkpoint import Checkpoint
from tomo_polysplat.fit.fitter import Fitter, views_of_a_pass
from tomo_polysplat.fit.fork import Question
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.stopping import Clock, FitState, Watch, is_true, patience_of
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings

__all__ = ["BUDGET_USED", "FitOutcome", "FitState", "OtherPhysics", "fit"]

logger = logging.getLogger(__name__)

BUDGET_USED = "the time budget was used"


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


class OtherPhysics(Exception):
    """A fit is to begin anew, under physics that its rays have shown.

    Attributes
    ----------
    found : dict
        The record of what told so; see `fit.calibration.calibrated`.
    outcome : FitOutcome
        What the fit had come to.
    """

    outcome: FitOutcome

    def __init__(self, found: dict[str, Any]) -> None:
        super().__init__(found["why"])
        self.found = found


@dataclass
class _Run:
    """All that changes during a run, and the file that keeps it, if there is one."""

    fitter: Fitter
    outcome: FitOutcome
    watch: Watch[Gaussians]
    clock: Clock
    started: float
    checkpoint: Checkpoint | None
    questions: Sequence[Question]
    look: Callable[[Fitter, Clock], Any] | None

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
            if any([is_true(callback(state)) for callback in callbacks]):
                self.keep(now=True)
                outcome.reason = "a callback ended it"
            if outcome.reason:
                return

    def _passes(self) -> Iterator[tuple[float, float, int]]:
        """What each pass gave; where something is asked, several at once, so that no checkpoint lies between them."""
        passes = self.fitter.passes(self.clock)
        while True:
            if self.look is not None:
                self.look(self.fitter, self.clock)
            if (asked := next((one for one in self.questions if one.due(self.clock)), None)) is not None:
                self.fitter, made = asked.answered(self.fitter, self.clock)
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
    questions: Sequence[Question] = (),
    look: Callable[[Fitter, Clock], Any] | None = None,
) -> FitOutcome:
    """Fit Gaussians to rays.

    Stops after ``settings.passes`` over the views, at ``deadline`` (``time.perf_counter`` seconds), when the
    held-out rays have not improved for `patience_of` passes, when a callback returns True, or on
    KeyboardInterrupt; returns the Gaussians that `Watch` holds for the best. Where ``checkpoint``
    holds a snapshot, ``gaussians`` are its own and the fit goes on from there. ``questions`` are asked on the
    way, and ``look`` is called between passes.

    Raises
    ------
    OtherPhysics
        That ``look`` raises, with what the fit had come to.
    """
    if not len(gaussians):
        logger.warning("The start volume is empty: no Gaussians, a volume of zeros.")
        return FitOutcome(gaussians, reason="nothing to fit: the start volume is empty")
    batch = min(views_per_step, len(rays.views))
    steps = max(1, math.ceil(settings.passes * views_of_a_pass(rays) / batch))
    outcome = FitOutcome(gaussians)
    watch: Watch[Gaussians] = Watch(patience_of(settings, settings.passes))
    # Nobody else holds the fitter, which makes room for another one where a question is answered by that.
    run = _Run(
        Fitter(gaussians, spacing, rays, scene, settings, batch, steps, rng),
        outcome,
        watch,
        # From now on: what compiling or recording the step took is no part of the run that the learning rates follow.
        clock := Clock(steps, deadline),
        started,
        checkpoint,
        questions,
        look,
    )
    run.restore()
    try:
        if not outcome.reason:
            run.follow(volume, callbacks)
    except KeyboardInterrupt:
        logger.warning("Interrupted after %d steps; the best state so far is returned.", clock.done)
        outcome.reason = "interrupted"
    except OtherPhysics as other:
        outcome.gaussians, outcome.reason = watch.best or gaussians.copy(), "interrupted"
        other.outcome = outcome
        raise
    outcome.reason = outcome.reason or _used_up(clock, settings)
    outcome.gaussians = watch.best or gaussians.copy()
    return outcome


def _used_up(clock: Clock, settings: Settings) -> str:
    """Why a run ended that nothing else had ended before."""
    if not clock.late:
        return f"{settings.passes:g} passes over the views were made"
    if clock.done:
        return BUDGET_USED
    logger.warning("The time budget ended before the first step: the result is no better than its start.")
    return f"{BUDGET_USED} before the first step"
