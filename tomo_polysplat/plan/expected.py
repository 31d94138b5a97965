"""What a run will take on this machine, told as soon as some of its steps have been timed."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

__all__ = ["Expected", "Told", "expected", "only_told", "tell"]

logger = logging.getLogger(__name__)

# By how much what is left of a run takes longer than its first steps would: questions are asked on the way by short
# fits and second runs, and Gaussians spread. On a CPU it came to 1.07 (pins, 24^3) and 1.21 (teeth, 32^3) with metal,
# 0.98 (lung, 36^3) and 0.95 (pepper, 48^3) without.
_LONGER = 1.05
# By how much where it is still to be asked whether pixels average light: the second way is a run of some passes, and
# averaged steps are slower. On a CPU it came to 1.2 and 1.35 (36^3), on a GPU (bone, 400^3 and 768^3) to 1.3 and 1.45
# with thin rays, and to 2.0 with averaged light.
_LIGHT_OPEN = 1.5
# A growing cloud has its last number of Gaussians for about this share of the run.
_GROWN = 0.7
# Less is not worth a line of the log, nor some words on compiling.
_WORTH_TELLING, _COMPILED = 10.0, 1.0


@dataclass(frozen=True)
class Expected:
    """What a run is expected to take.

    Attributes
    ----------
    seconds : float
        Of all of it, compiling left out.
    so_far : float
        Of these, until it was told.
    steps : int
    a_step : float
        Seconds of one, as timed.
    memory : str
        What the steps take on the device, and of how much.
    compiled : float
        Seconds that compiling took until it was told. They are no part of the others.
    """

    seconds: float
    so_far: float
    steps: int
    a_step: float
    memory: str
    compiled: float = 0.0

    def describe(self) -> str:
        """A line."""
        fitted = f"{self.steps} steps of {1e3 * self.a_step:.3g} ms"
        start = f"{_duration(self.so_far)} of it until the first steps"
        line = f"about {_duration(self.seconds)} in all, {start}; {fitted}; {self.memory}"
        if self.compiled > _COMPILED:
            line += f"; compiling took {_duration(self.compiled)} besides, which comes once a machine"
        return line


class Told(Exception):  # noqa: N818  # no error: a run that was to tell this only has told it
    """Ends a run that was only to tell what it would take."""


@dataclass
class _Asked:
    found: list[Expected] = field(default_factory=list)


_ASKED: ContextVar[_Asked | None] = ContextVar("_ASKED", default=None)


@contextmanager
def only_told() -> Iterator[list[Expected]]:
    """A run within ends once it is known what it would take, which is in the list then; empty after a shorter run."""
    before = _ASKED.set(asked := _Asked())
    try:
        yield asked.found
    except Told:
        pass
    finally:
        _ASKED.reset(before)


# Plain numbers of a run, by their names.
def expected(
    steps: int,
    done: int,
    a_step: float,
    so_far: float,
    growth: float,
    memory: str,
    *,
    light_open: bool = False,
    compiled: float = 0.0,
) -> Expected:
    """From the seconds of a step as timed.

    Parameters
    ----------
    steps, done : int
        Of the run, and those made.
    a_step, so_far : float
        Seconds of a step, and of all until now.
    growth : float
        Times as many Gaussians as now at the end.
    memory : str
    light_open : bool
        Whether it is still to be asked if pixels average light.
    compiled : float
        Seconds of compiling, of which `so_far` has none.
    """
    longer = (_LIGHT_OPEN if light_open else _LONGER) * (1 + _GROWN * (max(growth, 1.0) - 1))
    seconds = so_far + longer * (steps - done) * a_step
    return Expected(seconds, so_far, steps, a_step, memory, compiled)


def tell(found: Expected, budget: float | None) -> None:
    """Say it in the log, unless that is soon over or ended by a budget; end a run that was to tell this only.

    Raises
    ------
    Told
        Within `only_told`.
    """
    if (asked := _ASKED.get()) is not None:
        asked.found.append(found)
        raise Told
    if budget is None and found.seconds - found.so_far > _WORTH_TELLING:
        logger.info("Expected: %s.", found.describe())


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.2g} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"
