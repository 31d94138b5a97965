"""A run that goes on both ways for a few passes, so that the rays tell which model explains them."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass

from tomo_polysplat.fit.fitter import Fitter
from tomo_polysplat.fit.optimise import Made
from tomo_polysplat.fit.stopping import Clock
from tomo_polysplat.start.initial import FEW_VIEWS

__all__ = ["FEWEST_PASSES", "Fork", "fork", "passes_of_a_fork", "why_no_fork"]

# A run of fewer passes is in a hurry.
FEWEST_PASSES = 10.0
# Passes of each way at least.
_PASSES = 2


@dataclass(frozen=True)
class Fork:
    """What both ways came to.

    Attributes
    ----------
    late : bool
        Whether time ran out before the other way was done.
    was, other : Made or None
        Errors of the last pass of the run as it was, and of the other way.
    """

    late: bool
    was: Made | None
    other: Made | None


def why_no_fork(passes: float, views: int) -> str:
    """Why a run of these passes over these views is asked nothing, if so."""
    if passes < FEWEST_PASSES:
        return "in so few passes more of them would take too long a part"
    if views < FEW_VIEWS:
        return f"fewer than {FEW_VIEWS} views do not tell"
    return ""


def passes_of_a_fork(fitter: Fitter, passes: float, steps: int, most: float) -> int:
    """Passes of each way that make ``steps``, but no more than a share ``most`` of the run's passes."""
    return max(_PASSES, min(math.ceil(steps / fitter.steps_of_a_pass), round(most * passes)))


def fork(
    fitter: Fitter, other: Fitter, clock: Clock, passes: int, enough: Callable[[], bool] | None = None
) -> Fork:
    """Go both ways for so many passes, or until ``enough``, asked after each, says so.

    The run's clock goes on with the first way. The second has a copy of it, which tells whether it came too late.
    """
    its_clock, at_once = copy.copy(clock), passes if enough is None else 1
    made: list[Made] = []
    its: list[Made] = []
    for _ in range(0, passes, at_once):
        made += fitter.ahead(clock, at_once)
        its += other.ahead(its_clock, at_once)
        if its_clock.late or (enough is not None and enough()):
            break
    return Fork(its_clock.late, _last(made), _last(its))


def _last(made: list[Made]) -> Made | None:
    """The errors of the last pass, and the pairs skipped in all."""
    return (*made[-1][:2], sum(skipped for _, _, skipped in made)) if made else None
