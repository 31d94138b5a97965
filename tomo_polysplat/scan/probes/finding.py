"""What a probe answers."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

__all__ = ["DEFECT", "OK", "UNKNOWN", "Finding", "Verdict"]


class Verdict(str, Enum):
    """What is known of one matter; equal to its text."""

    OK = "ok"
    DEFECT = "defect"
    UNKNOWN = "unknown"

    def __str__(self) -> str:
        return self.value


OK, DEFECT, UNKNOWN = Verdict.OK, Verdict.DEFECT, Verdict.UNKNOWN


@dataclass(frozen=True)
class Finding:
    """The answer of one probe.

    Attributes
    ----------
    probe : str
        What was looked for.
    verdict : Verdict
        "ok" where a defect would have shown, "defect" where one shows beyond the scan's noise, "unknown" where the
        scan cannot tell.
    text : str
        What was found, or why the scan cannot tell.
    remedy : str
        How to mend a defect; of what is unknown, what it would take to know.
    values : dict
        The numbers behind it.
    uncertainty : float or None
        Standard error of the number that was judged, in its own unit, from the scan's noise.
    """

    probe: str
    verdict: Verdict
    text: str
    remedy: str = ""
    values: dict[str, float] = field(default_factory=dict)
    uncertainty: float | None = None

    @property
    def misleading(self) -> bool:
        """Whether it would mislead other probes: any defect but one of a few views."""
        return self.verdict == DEFECT and self.values.get("misplaced", 1.0) > 0.1
