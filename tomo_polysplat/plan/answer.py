"""An answer to a question of the plan, as data that JSON can hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

__all__ = ["Answer", "Status"]


class Status(str, Enum):
    """Where an answer comes from."""

    GIVEN = "given"
    """The caller's settings say it."""
    ASKED = "asked"
    """The data were asked."""
    USUAL = "usual"
    """Nobody was asked: the usual value."""
    FOUND = "found"
    """No choice: a fact about the scan or the run."""


@dataclass(frozen=True)
class Answer:
    """What was decided or found.

    Attributes
    ----------
    value : anything that JSON can hold
    why : str
        For a reader; nothing decides by it.
    status : Status
    evidence : mapping of str to float
        The numbers that it rests on.
    """

    value: Any
    why: str
    status: Status
    evidence: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def found(cls, value: Any, why: str = "") -> Answer:
        """A fact."""
        return cls(value, why, Status.FOUND)

    def __str__(self) -> str:
        value = f"{self.value:.4g}" if isinstance(self.value, float) else f"{self.value}"
        if isinstance(self.value, bool):
            value = "yes" if self.value else "no"
        return f"{value}: {self.why}" if self.why else value

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "value": self.value,
            "why": self.why,
            "status": self.status.value,
            "evidence": dict(self.evidence),
        }

    @classmethod
    def from_dict(cls, parts: Mapping[str, Any]) -> Answer:
        """The answer of `to_dict`.

        Raises
        ------
        TypeError
            If the parts are not those of an answer.
        """
        if not isinstance(parts, Mapping) or set(parts) != {"value", "why", "status", "evidence"}:
            raise TypeError(f"the parts of an answer, got {parts!r}")
        evidence, why = parts["evidence"], parts["why"]
        if not isinstance(why, str) or not isinstance(evidence, Mapping):
            raise TypeError(f"an answer with words and evidence, got {parts!r}")
        if not all(isinstance(number, int | float) for number in evidence.values()):
            raise TypeError(f"evidence in numbers, got {evidence!r}"[:200])
        try:
            return cls(parts["value"], why, Status(parts["status"]), dict(evidence))
        except ValueError as error:
            raise TypeError(f"{error}") from error
