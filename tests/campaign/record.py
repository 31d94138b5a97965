"""What was tried and what came of it: a table that can be added to from run to run."""

from __future__ import annotations

import json
import os
import platform
from pathlib import Path

__all__ = ["Record"]

FAULTS = ("crashed", "mixed", "lost", "over time", "over memory", "no words")


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
        """In Markdown: how often each was tried, what was accepted, and faults where there are any."""
        kinds = dict.fromkeys(what.split(": ")[0] for what in self.rows)
        groups: list[list[str]] = []
        for kind in kinds:
            # What is killed and what finds a disk full are the same files.
            like = [group for group in groups if self._names(group[0]) & self._names(kind)]
            like[0].append(kind) if like else groups.append([kind])
        return "\n\n".join([*map(self._table_of, groups), self._faults()])

    def _names(self, kind: str) -> set[str]:
        return {what.partition(": ")[2] for what in self.rows if what.split(": ")[0] == kind}

    def _table_of(self, kinds: list[str]) -> str:
        names = dict.fromkeys(what.partition(": ")[2] for what in self.rows if what.split(": ")[0] in kinds)
        cells = [(kind, "tried") for kind in kinds]
        cells += [(kind, "accepted") for kind in kinds if self.total(kind, "accepted")]
        alone = len(kinds) == 1
        heads = [
            column if alone else kind if column == "tried" else f"{kind}, {column}" for kind, column in cells
        ]
        lines = [f"| {kinds[0] if alone else ''} | {' | '.join(heads)} |", f"|---|{'---|' * len(heads)}"]
        for name in names:
            rows = [self.rows.get(f"{kind}: {name}", {}).get(column, 0) for kind, column in cells]
            lines.append(f"| {name} | {' | '.join(map(str, rows))} |")
        sums = [f"**{self.total(kind, column)}**" for kind, column in cells]
        return "\n".join([*lines, f"| **all** | {' | '.join(sums)} |"])

    def _faults(self) -> str:
        found = [
            f"{row[fault]} {fault} ({what})"
            for what, row in self.rows.items()
            for fault in FAULTS
            if row.get(fault)
        ]
        return f"Faults: {'; '.join(found) or 'none'}. Looked for: {', '.join(FAULTS)}."

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
