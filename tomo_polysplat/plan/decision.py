"""The protocol of a decision: a question whose answer changes the plan."""

from __future__ import annotations

from abc import ABC, abstractmethod
from enum import Enum
from typing import Any, ClassVar

from tomo_polysplat.plan.answer import Answer
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.settings import Settings

__all__ = ["Decision", "Known", "When", "is_number"]

# Of what a plan counts, in any unit: beyond these single precision fails.
_SMALLEST, _LARGEST = 1e-9, 1e9


def is_number(value: Any, least: float = -_LARGEST) -> bool:
    """Whether a value from a file is a number that a fit can count with."""
    return type(value) in (int, float) and least <= value <= _LARGEST


class When(str, Enum):
    """When a question is asked."""

    START = "start"
    """Of the start volume and the geometry."""
    TRIAL = "trial"
    """By short fits, before the run."""
    DURING = "during"
    """Between two passes of the run."""


class Known:
    """The answers that one decision may read: those in its ``needs``."""

    def __init__(self, plan: Plan, reader: type[Decision]) -> None:
        self._plan, self._reader = plan, reader

    def answer(self, needed: type[Decision]) -> Answer:
        """The answer of a decision that was made before.

        Raises
        ------
        LookupError
            For one that the reader does not name in its ``needs``.
        """
        if needed not in self._reader.needs:
            raise LookupError(f"{self._reader.__name__} does not name {needed.__name__} in its needs")
        return self._plan.answers[needed.name]

    def __getitem__(self, needed: type[Decision]) -> Any:
        return self.answer(needed).value


class Decision(ABC):
    """A question; one a file, called like its file, its key in the plan and its field in the settings.

    Attributes
    ----------
    name : str
    needs : tuple of Decision classes
        Whose answers it may read; they stand before it in `plan.order.ORDER`.
    when : When
    share : float
        Of the run that must be done before it is asked, for one that is asked during the run.
    """

    name: ClassVar[str] = ""
    needs: ClassVar[tuple[type[Decision], ...]] = ()
    when: ClassVar[When] = When.START
    share: ClassVar[float] = 0.0

    def given(self, settings: Settings) -> Any | None:
        """What the caller's settings say; None leaves it to the plan."""
        return getattr(settings, self.name)

    def valid(self, value: Any) -> bool:
        """Whether a value that was read from a file may be this one's answer; here, a number above zero."""
        return is_number(value, _SMALLEST)

    def why_not(self, known: Known, lab: Lab) -> str:
        """Why it need not be asked, if so."""
        return ""

    def usual(self, known: Known, lab: Lab) -> Any:
        """The value where it is not asked, or not told; None for one that is always asked and always told."""
        return None

    @abstractmethod
    def ask(self, known: Known, lab: Lab) -> Answer:
        """The answer of the data.

        Raises
        ------
        Untold
            If they do not tell.
        """

    def alternative(self, lab: Lab) -> str:
        """What another choice would cost; nothing where there is no other, or it was given."""
        return ""
