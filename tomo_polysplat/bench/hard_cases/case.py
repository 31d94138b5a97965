"""A hard case, and what it found: numbers against bounds."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

__all__ = ["Case", "Findings", "refused"]


@dataclass(frozen=True)
class Case:
    """One difficulty and what must come of it.

    Attributes
    ----------
    name : str
    why : str
        Where its bounds come from.
    run : callable
        From a device's name to :class:`Findings`; a function of a module, so that another process finds it.
    limit : float
        Seconds after which it counts as hung.
    """

    name: str
    why: str
    run: Callable[[str], Findings]
    limit: float = 120.0


@dataclass
class Findings:
    """Numbers with what they had to be.

    Attributes
    ----------
    entries : list of dict
        JSON-able: ``what``, ``bound`` (in words), ``got`` (a number, or words) and ``passed``.
    """

    entries: list[dict[str, Any]] = field(default_factory=list)

    def at_most(self, what: str, value: float, bound: float) -> None:
        """A number that must not exceed a bound; NaN does."""
        self._add(what, f"<= {bound:.3g}", float(value), value <= bound)

    def at_least(self, what: str, value: float, bound: float) -> None:
        """A number that must reach a bound; NaN does not."""
        self._add(what, f">= {bound:.3g}", float(value), value >= bound)

    def equal(self, what: str, value: Any, expected: Any) -> None:
        """A count, a truth value or words, exactly."""
        self._add(what, f"{expected}", value, value == expected)

    def _add(self, what: str, bound: str, got: Any, passed: Any) -> None:
        finite = not isinstance(got, float) or math.isfinite(got)
        self.entries.append(
            {"what": what, "bound": bound, "got": got if finite else str(got), "passed": bool(passed)}
        )

    @property
    def passed(self) -> bool:
        """Whether everything was as it had to be; a case that looked at nothing was not."""
        return bool(self.entries) and all(entry["passed"] for entry in self.entries)


def refused(function: Callable[..., Any], error: type[Exception], words: str) -> Findings:
    """That a reconstruction is refused before it starts.

    Parameters
    ----------
    function : callable
        Called with ``progress``, a function that must not be called.
    error : type
        The exception.
    words : str
        What its message must hold, such as the argument's name.
    """
    reports: list[str] = []
    findings, got, message = Findings(), "none", ""
    try:
        function(progress=lambda share, words: reports.append(words))
    except Exception as problem:
        got, message = type(problem).__name__, str(problem)
    findings.equal("exception", got, error.__name__)
    findings.equal(f"message names {words!r}", words in message, True)
    findings.equal("refused before work starts", not reports, True)
    return findings
