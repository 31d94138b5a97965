"""What was tried and what came of it: a table that can be added to from run to run."""

from __future__ import annotations

import json
import os
import platform
from pathlib import Path

__all__ = ["Record"]

FAULTS = ("crashed", "mixed", "lost", "over time", "over memory", "no words")
COLUMNS = ("tried", "accepted", *FAULTS)


class Record:
    """Counts by what was tried.

    Parameters
    ----------
    path : Path or None
        A file of JSON with the counts of earlier runs, to which these are added.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.path, self.rows, self.findings = path, {}, []
        self.slowest, self.most, self.seconds = 0.0, 0, 0.0
        if path is not None and path.exists():
            kept = json.loads(path.read_text(encoding="utf-8"))
            self.rows, self.slowest, self.most = kept["rows"], kept["slowest"], kept["most"]
            self.seconds = kept["seconds"]

    def tried(self, what: str) -> None:
        self.count(what, "tried", 1)

    def count(self, what: str, column: str, number: int) -> None:
        row = self.rows.setdefault(what, {})
        row[column] = row.get(column, 0) + number

    def found(self, what: str, column: str, words: str) -> None:
        """A fault, with what tells where to look."""
        self.count(what, column, 1)
        self.findings.append(f"{column}: {words}")

    def largest(self, what: str, seconds: float, size: int) -> None:
        self.slowest, self.most = max(self.slowest, seconds), max(self.most, size)

    def save(self) -> None:
        if self.path is not None:
            kept = {name: getattr(self, name) for name in ("rows", "slowest", "most", "seconds")}
            self.path.write_text(json.dumps(kept, indent=1), encoding="utf-8")

    def total(self, kind: str, column: str) -> int:
        return sum(row.get(column, 0) for what, row in self.rows.items() if what.split(":")[0] == kind)

    def table(self) -> str:
        """In Markdown, a sum for each kind first."""
        kinds = dict.fromkeys(what.split(":")[0] for what in self.rows)
        lines = [f"| what | {' | '.join(COLUMNS)} |", f"|---|{'---|' * len(COLUMNS)}"]
        for kind in kinds:
            sums = [self.total(kind, column) for column in COLUMNS]
            lines.append(f"| **{kind}, all** | {' | '.join(map(_bold, sums))} |")
            for what, row in self.rows.items():
                if what.split(":")[0] == kind:
                    lines.append(f"| {what} | {' | '.join(str(row.get(column, 0)) for column in COLUMNS)} |")
        return "\n".join(lines)

    def conditions(self) -> str:
        """Where, how long, and the most that reading a file took."""
        import h5py
        import numpy
        import tifffile

        versions = ", ".join(f"{one.__name__} {one.__version__}" for one in (numpy, h5py, tifffile))
        return (
            f"{platform.system()}, {os.cpu_count()} CPU cores, Python {platform.python_version()}, {versions}; "
            f"{self.seconds / 60:.0f} minutes.\n"
            f"The slowest file took {self.slowest:.2f} s of the CPU, the largest {self.most / 2**20:.0f} MB."
        )


def _bold(number: int) -> str:
    return f"**{number}**"
