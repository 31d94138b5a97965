"""When a run ends, and which of its states is kept."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from tomo_polysplat.kernels.compile_time import working_time

__all__ = [
    "BY_TIME",
    "Clock",
    "FitState",
    "Fitted",
    "Pace",
    "Tick",
    "Stop",
    "StopReason",
    "Watch",
    "is_true",
    "usual_patience",
]

_Fitted = TypeVar("_Fitted", bound="Fitted")
# Is told the share of a run that there is room for, and the seconds that it lacks.
Pace = Callable[[float, float], Any]
# What is told the share of a run that is done, within its passes too, and at least how many seconds apart.
Tick = Callable[[float], Any]
_TICK = 0.5

# The few held-out rays of one pass may fit well by chance, and a state long before the end would be kept: 35 runs on
# 24^3 to 128^2 voxels missed 0.16 dB in the mean and 2.8 at most of their best pass, with means of four 0.05 and 0.6.
_AVERAGED = 4
# A held-out error that falls by less than this share in a pass over the views has stopped falling.
_IMPROVEMENT = 2e-3
# Share of a run's passes, and passes at least, without improvement that end it. While the learning rates are high the
# held-out error goes up and down: with 4 passes, runs of 20 ended after 8 and 10 (slices of 64^2: 19.4 for 23.2 dB).
_PATIENCE, _LEAST_PATIENCE = 0.4, 4
# Between the ends of these steps a run's pace is measured; what the first one waits for is not the pace.
_PACED = (1, 4)
# Seconds, or the share of a run, over which a step is timed, and in whole numbers of so many: some smooth, some do not.
_TIMED, _SHARE_TIMED, _ALIKE = 1.0, 0.1, 4


class StopReason(str, Enum):
    """What ended a run."""

    PASSES = "passes"
    HELD_OUT = "held out"
    CALLBACK = "callback"
    BUDGET = "budget"
    BUDGET_BEFORE_FIRST_STEP = "budget before the first step"
    NOT_FINITE = "not finite"
    INTERRUPTED = "interrupted"
    RESTART = "restart"
    EMPTY = "empty"


# The time budget's.
BY_TIME = (StopReason.BUDGET, StopReason.BUDGET_BEFORE_FIRST_STEP)


@dataclass(frozen=True)
class Stop:
    """What ended a run, and words that say so."""

    reason: StopReason
    words: str

    @property
    def by_time(self) -> bool:
        """Whether the time budget did."""
        return self.reason in BY_TIME


@dataclass
class FitState:
    """What a callback sees, once a pass over the views.

    Attributes
    ----------
    seconds : float
        Since the reconstruction began.
    iteration, gaussians : int
    loss, held_out : float
        Mean misfit of the fitted and of the held-out rays over the pass; NaN where too few were held out.
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

    def describe(self) -> str:
        """A few words for a progress bar."""
        if math.isnan(self.held_out):
            return f"error {self.loss:.2e}"
        return f"held-out error {self.held_out:.2e}"

    def record(self) -> dict[str, Any]:
        """The numbers, for the history."""
        names = ("seconds", "iteration", "loss", "held_out", "gaussians")
        values = {name: getattr(self, name) for name in names} | {"stage": "fit"}
        return values | ({"held_out": None} if math.isnan(self.held_out) else {})


class Clock:
    """How much of a run is done: of its steps or of its time, whichever ends first."""

    def __init__(
        self,
        steps: int,
        deadline: float | None,
        tell: Pace | None = None,
        tick: Tick | None = None,
        timed: Callable[[Clock, float], Any] | None = None,
    ) -> None:
        self.steps, self.deadline, self.begun, self.done = steps, deadline, working_time(), 0
        self._tell, self._settled = tell, self.begun
        self._tick, self._ticked = tick, self.begun
        self._timed, self._since = timed, (0, self.begun)

    @property
    def late(self) -> bool:
        """Whether the deadline has passed."""
        return self.deadline is not None and working_time() >= self.deadline

    def share(self) -> float:
        """From 0 to 1.

        Time counts where it is a step ahead: with time to spare a run is the one without a deadline, bit for bit.
        """
        by_steps = self.done / self.steps
        if self.deadline is None:
            return by_steps
        if self.late:
            return 1.0
        by_time = (working_time() - self.begun) / (self.deadline - self.begun)
        return by_time if by_time > by_steps + 1 / self.steps else by_steps

    def expected_steps(self, seconds: float) -> int:
        """How many steps the run comes to where each of those left takes these ``seconds``."""
        if self.deadline is None:
            return self.steps
        left = max(self.deadline - working_time(), 0.0)
        return min(self.steps, self.done + math.ceil(left / max(seconds, 1e-9)))

    def look_ahead(self, settle: Callable[[], Any]) -> None:
        """After a few steps, tell what share of the run a deadline has room for, and seconds that it lacks.

        ``settle`` waits until the steps that were asked for are done: a GPU makes them later.
        """
        self._time_some(settle)
        first, last = _PACED
        if self._tell is None or self.deadline is None or self.done not in _PACED:
            return
        settle()
        now = working_time()
        if self.done == last:
            pace = max(now - self._settled, 1e-9) / (last - first)
            left = max(self.deadline - now, 0.0)
            room = (last + left / pace) / self.steps
            self._tell(min(room, 1.0), max((self.steps - last) * pace - left, 0.0))
        self._settled = now

    def tick(self) -> None:
        """After a step, tell the share that is done, though not more often than somebody can read."""
        if self._tick is None or (now := working_time()) - self._ticked < _TICK:
            return
        self._ticked = now
        self._tick(self.share())

    def _time_some(self, settle: Callable[[], Any]) -> None:
        """Tell once, early on, how long a step takes."""
        if self._timed is None:
            return
        since, then = self._since
        made = self.done - since
        if since and (made % _ALIKE or made == 0):
            return
        if since and working_time() - then < _TIMED and made < _SHARE_TIMED * self.steps:
            return
        settle()
        if since:
            timed, self._timed = self._timed, None
            timed(self, (working_time() - then) / made)
        # What the first step waits for is no pace.
        self._since = self.done, working_time()

    def allows(self, slower: float) -> bool:
        """Whether the steps left, slower than those so far by this factor, would end before the deadline."""
        return self.room_for(slower * (self.steps - self.done))

    def room_for(self, steps: float) -> bool:
        """Whether these steps would end before the deadline."""
        if self.deadline is None:
            return True
        now = working_time()
        return now + steps * (now - self.begun) / max(self.done, 1) <= self.deadline


def usual_patience(passes: float) -> int:
    """Passes without improvement that end a run of so many."""
    return max(_LEAST_PATIENCE, math.ceil(_PATIENCE * passes))


class Fitted(Protocol):
    """What is fitted: Gaussians, or the voxels that they are compared with."""

    def copy(self: _Fitted) -> _Fitted:
        """Which later steps leave alone."""

    def finite(self) -> bool:
        """Whether every parameter is a finite number."""


class Watch(Generic[_Fitted]):
    """Keeps the best state and says when to stop: after ``patience`` passes without improvement.

    The best state is the one after the pass at which the mean held-out error of that pass and the three before is
    lowest. Where no ray is held out, the misfit of the fitted ones takes its place; a pass that met none of those
    that are says nothing.

    Parameters
    ----------
    patience : int
    keep : callable, optional
        Makes of what is fitted a copy that later steps leave alone, and may use what it has made before for that.
    """

    def __init__(
        self,
        patience: int,
        keep: Callable[[_Fitted, _Fitted | None], _Fitted] = lambda fitted, _: fitted.copy(),
    ) -> None:
        self.patience, self._keep = patience, keep
        self.best: _Fitted | None = None
        self.recent: list[float] = []
        self.by_held_out = False
        self.lowest = math.inf
        self.waited = 0

    def judge(self, state: FitState, fitted: _Fitted) -> Stop | None:
        """The reason to stop, if there is one."""
        if not (math.isfinite(state.loss) and fitted.finite()):
            if self.best is None:
                raise FloatingPointError(
                    "the fit diverged in its first pass: projections that are not -log(I/I0), or rates set too high"
                )
            return Stop(StopReason.NOT_FINITE, "the fit stopped being finite")
        if self._note(state.loss, state.held_out):
            # None while it is made: whoever interrupts that goes on from what is fitted, which is the best.
            before, self.best = self.best, None
            self.best = self._keep(fitted, before)
        if self.by_held_out and self.waited >= self.patience:
            words = f"the held-out rays had not improved for {self.waited} passes"
            return Stop(StopReason.HELD_OUT, words)
        return None

    def recall(self, history: Sequence[Mapping[str, Any]], best: _Fitted | None) -> None:
        """Go on after the passes of a ``history``, of whose states ``best`` was kept."""
        for entry in history:
            self._note(entry["loss"], math.nan if entry["held_out"] is None else entry["held_out"])
        self.best = best

    def _note(self, loss: float, held_out: float) -> bool:
        """Whether the state after a pass of these errors is the best so far."""
        if math.isfinite(held_out) and not self.by_held_out:
            self.by_held_out, self.recent, self.lowest = True, [], math.inf
        error = held_out if self.by_held_out else loss
        if math.isnan(error):
            return False
        self.recent = [*self.recent, error][-_AVERAGED:]
        score = sum(self.recent) / len(self.recent)
        self.waited = 0 if score < (1 - _IMPROVEMENT) * self.lowest else self.waited + 1
        best = score <= self.lowest
        self.lowest = min(score, self.lowest)
        return best


def is_true(answer: Any) -> bool:
    """Whether a callback said True; whatever else a function happens to return is no answer."""
    return isinstance(answer, (bool, np.bool_)) and bool(answer)
