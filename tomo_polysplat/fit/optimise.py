"""A fit: pass by pass until something ends it, and what it keeps."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from tomo_polysplat.fit.fitter import Batches, Fitter, steps_of_a_run
from tomo_polysplat.fit.memory import told_of_lack
from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.fit.snapshot import Keeps
from tomo_polysplat.fit.stopping import (
    Clock,
    FitState,
    Pace,
    Stop,
    StopReason,
    Tick,
    Watch,
    is_true,
    usual_patience,
)
from tomo_polysplat.kernels.compile_time import working_time
from tomo_polysplat.model.gaussians import Gaussians

__all__ = ["Between", "Course", "FitOutcome", "FitState", "Made", "Run", "fit"]

logger = logging.getLogger(__name__)

# Mean misfit of the fitted and of the held-out rays, and the pairs skipped.
Made = tuple[float, float, int]


@dataclass
class FitOutcome:
    """Fitted Gaussians with the record of the run.

    Attributes
    ----------
    gaussians : Gaussians
    history : list of dict
        One entry a pass.
    skipped_pairs, relocated : int
    stop : Stop or None
        What ended the run.
    restart : anything, or None
        What a question found that the run is to begin anew with.
    start : tensor or None
        The volume that it began from, on the host, where that explains the rays better.
    """

    gaussians: Gaussians
    history: list[dict[str, Any]] = field(default_factory=list)
    skipped_pairs: int = 0
    relocated: int = 0
    stop: Stop | None = None
    restart: Any = None
    start: torch.Tensor | None = None

    def counts(self) -> dict[str, int]:
        """What was skipped or held at a bound."""
        return {
            "gaussians": len(self.gaussians),
            "gaussians_at_zero": int((self.gaussians.attenuation <= 0).sum()),
            "gaussians_relocated": self.relocated,
            "pairs_skipped_at_source": self.skipped_pairs,
        }


@dataclass
class Run:
    """A run that is under way, as what is called between its passes sees it.

    Attributes
    ----------
    fitter : Fitter
        To be replaced where a question is answered by another one.
    clock : Clock
    made : (float, float, int) or None
        To be set by who has made passes: errors of the last one, and the pairs skipped in all of them.
    restart : anything, or None
        To be set where the run is to begin anew with it.
    """

    fitter: Fitter
    clock: Clock
    made: Made | None = None
    restart: Any = None


# What is called between two passes.
Between = Callable[[Run], Any]


@dataclass(kw_only=True)
class _Keeper(Run):
    """All that changes during a run, and the file that keeps it, if there is one."""

    outcome: FitOutcome
    watch: Watch[Gaussians]
    started: float
    checkpoint: Keeps | None
    between: Between | None

    def keep(self, *, now: bool) -> None:
        """Offer the checkpoint the state between two passes."""
        if self.checkpoint is not None:
            self.checkpoint.offer(lambda: self.fitter.snapshot(self.watch.best, self._numbers()), now=now)

    def _numbers(self) -> dict[str, Any]:
        outcome, clock = self.outcome, self.clock
        return {
            "steps": clock.done,
            "seconds": working_time() - self.started,
            "begun": clock.begun - self.started,
            "history": outcome.history,
            "skipped_pairs": outcome.skipped_pairs,
            "stop": None if outcome.stop is None else [outcome.stop.reason.value, outcome.stop.words],
        }

    def restore(self) -> None:
        """Go on from the checkpoint's snapshot, where there is one."""
        if self.checkpoint is None or self.checkpoint.snapshot is None:
            return
        kept, self.checkpoint.snapshot = self.checkpoint.snapshot, None
        numbers = kept.numbers
        self.fitter.restore(kept)
        self.clock.done, self.clock.begun = numbers["steps"], self.started + numbers["begun"]
        self.watch.recall(numbers["history"], None if kept.best is None else kept.best.kept(None))
        self.outcome.history, stop = numbers["history"], numbers["stop"]
        self.outcome.stop = None if stop is None else Stop(StopReason(stop[0]), stop[1])
        self.outcome.skipped_pairs = numbers["skipped_pairs"]
        self.outcome.relocated = self.fitter.relocated

    def follow(
        self, volume: Callable[[Gaussians], np.ndarray], callbacks: Sequence[Callable[[FitState], Any]]
    ) -> None:
        """Pass by pass until something ends the run, which the outcome's ``stop`` then says."""
        outcome = self.outcome
        for loss, held_out, skipped in self._passes():
            outcome.skipped_pairs += skipped
            outcome.relocated = self.fitter.relocated
            state = self._state(loss, held_out, volume)
            outcome.history.append(state.record())
            outcome.stop = self.watch.judge(state, self.fitter.gaussians)
            self.keep(now=outcome.stop is not None or self.clock.share() >= 1)
            if any([is_true(callback(state)) for callback in callbacks]):
                self.keep(now=True)
                outcome.stop = Stop(StopReason.CALLBACK, "a callback ended it")
            if outcome.stop is not None:
                return

    def _passes(self) -> Iterator[tuple[float, float, int]]:
        """What each pass gave; where something is asked, several at once, so that no checkpoint lies between them."""
        while True:
            self.made = None
            if self.between is not None:
                self.between(self)
            if self.restart is not None:
                self.outcome.restart = self.restart
                self.outcome.stop = Stop(StopReason.RESTART, "begun anew")
                return
            one = self.made or next(self.fitter.passes(self.clock), None)
            if one is None:
                return
            yield one

    def _state(self, loss: float, held_out: float, volume: Callable[[Gaussians], np.ndarray]) -> FitState:
        gaussians, clock = self.fitter.gaussians, self.clock
        seconds = working_time() - self.started
        numbers = (seconds, clock.done, len(gaussians), loss, held_out, clock.share())
        return FitState(*numbers, lambda: volume(gaussians))


@dataclass(frozen=True, kw_only=True)
class Course:
    """How a fit runs, and whom it tells.

    Attributes
    ----------
    views_per_step : int
    rng : numpy.random.Generator
        Of the order of the views.
    started : float
        When, in seconds of ``working_time``.
    volume : callable
        Makes the volume of Gaussians, for callbacks.
    deadline : float or None
        When the fit ends at the latest, in the same seconds.
    callbacks : sequence of callables
        Called once a pass; one that returns True ends the fit.
    checkpoint : Keeps or None
        Where it holds a snapshot, the fit goes on from there.
    between : callable or None
        Called between passes; asks what the plan left open.
    pace : callable or None
        Is told early on what a deadline has room for.
    tick : callable or None
        Is told the share that is done, also within a pass.
    timed : callable or None
        Is told once, early on, the seconds of a step.
    """

    views_per_step: int
    rng: np.random.Generator
    started: float
    volume: Callable[[Gaussians], np.ndarray]
    deadline: float | None = None
    callbacks: Sequence[Callable[[FitState], Any]] = ()
    checkpoint: Keeps | None = None
    between: Between | None = None
    pace: Pace | None = None
    tick: Tick | None = None
    timed: Callable[[Clock, float], Any] | None = None


@told_of_lack()
def fit(setup: FitSetup, course: Course) -> FitOutcome:
    """Fit Gaussians to rays.

    Stops after ``settings.passes`` over the views, at the deadline, when the held-out rays have not improved for
    ``settings.patience`` passes (`usual_patience`), when a callback returns True, or on KeyboardInterrupt. Returns the
    Gaussians that `Watch` holds for the best. Where the checkpoint holds a snapshot, the Gaussians are its own.

    Raises
    ------
    MemoryError
        If a GPU is full all the same; with what to do.
    """
    gaussians, rays, settings = setup.gaussians, setup.rays, setup.settings
    if not len(gaussians):
        logger.warning("The start volume is empty: no Gaussians, a volume of zeros.")
        words = "nothing to fit: the start volume is empty"
        return FitOutcome(gaussians, stop=Stop(StopReason.EMPTY, words))
    batch = min(course.views_per_step, len(rays.views))
    passes = settings.passes or 1.0
    steps, outcome = steps_of_a_run(passes, rays, batch), FitOutcome(gaussians)
    watch: Watch[Gaussians] = Watch(settings.patience or usual_patience(passes), Gaussians.kept)
    # Nobody else holds the fitter, which makes room for another one where a question is answered by that.
    run = _Keeper(
        Fitter(setup, Batches(batch, steps, course.rng)),
        # From now on: what compiling or recording the step took is no part of the run that the learning rates follow.
        clock := Clock(steps, course.deadline, course.pace, course.tick, course.timed),
        outcome=outcome,
        watch=watch,
        started=course.started,
        checkpoint=course.checkpoint,
        between=course.between,
    )
    run.restore()
    try:
        if outcome.stop is None:
            run.follow(course.volume, course.callbacks)
    except KeyboardInterrupt:
        logger.warning("Interrupted after %d steps; the best state so far is returned.", clock.done)
        outcome.stop = Stop(StopReason.INTERRUPTED, "interrupted")
    outcome.stop = outcome.stop or _used_up(clock, passes)
    # The fitter's, which may have grown, where nothing was kept.
    outcome.gaussians = (watch.best or run.fitter.gaussians).to(gaussians.position.device)
    return outcome


def _used_up(clock: Clock, passes: float) -> Stop:
    """Why a run ended that nothing else had ended before."""
    if not clock.late:
        return Stop(StopReason.PASSES, f"{passes:g} passes over the views were made")
    if clock.done:
        return Stop(StopReason.BUDGET, "the time budget was used")
    logger.warning("The time budget ended before the first step: the result is no better than its start.")
    words = "the time budget was used before the first step"
    return Stop(StopReason.BUDGET_BEFORE_FIRST_STEP, words)
