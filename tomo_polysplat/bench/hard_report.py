"""The record of the hard cases as a table for a terminal, and as one in Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tomo_polysplat.bench.tables import markdown_table, text_table

__all__ = ["as_markdown", "as_text"]

_WIDEST = 76


def as_text(record: Mapping[str, Any]) -> str:
    """One line a finding: case, what, expected, got, seconds, pass."""
    rows = [row for entry in record["cases"] for row in _rows(entry)]
    table = text_table(("case", "pass", "s", "expected", "got"), [(*row[:3], *_cut(row[3:])) for row in rows])
    return f"{table}\n{_summary(record)}"


def _rows(entry: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """The lines of one case: its name, its outcome and its seconds stand in the first."""
    lines = [(f"{f['what']} {_sign(f['bound'])}", _got(f)) for f in entry["findings"]]
    if entry["error"]:
        lines.append((entry["why"], entry["error"]))
    heads = [(entry["name"], "yes" if entry["passed"] else "NO", f"{entry['seconds']:.1f}")]
    heads += [("", "", "")] * (len(lines) - 1)
    return [(*head, *line) for head, line in zip(heads, lines)]


def _cut(texts: Sequence[str]) -> list[str]:
    return [text if len(text) <= _WIDEST else text[: _WIDEST - 3] + "..." for text in texts]


def _sign(bound: str) -> str:
    return bound if bound[:2] in ("<=", ">=") else f"= {bound}"


def _got(finding: Mapping[str, Any]) -> str:
    value = finding["got"]
    words = f"{value:.3g}" if isinstance(value, float) else str(value)
    return words if finding["passed"] else f"{words} FAILED"


def _summary(record: Mapping[str, Any]) -> str:
    cases = record["cases"]
    failed = [entry["name"] for entry in cases if not entry["passed"]]
    seconds = sum(entry["seconds"] for entry in cases)
    words = (
        f"{len(cases) - len(failed)} of {len(cases)} cases passed on {record['device']} in {seconds:.0f} s"
    )
    return f"{words}; failed: {', '.join(failed)}" if failed else words


def as_markdown(record: Mapping[str, Any]) -> str:
    """One line a case: what had to be, what was, and why the bound is what it is."""
    rows = []
    for entry in record["cases"]:
        lines = _rows(entry)
        expected, got = ("; ".join(line[place] for line in lines) for place in (3, 4))
        rows.append((entry["name"], expected, got, lines[0][2], lines[0][1], entry["why"]))
    machine = record["environment"]["gpus"][:1] if record["device"].startswith("cuda") else []
    where = (
        machine[0]
        if machine
        else f"{record['environment']['cpu']}, {record['environment']['threads']} threads"
    )
    table = markdown_table(("case", "expected", "got", "s", "pass", "why this bound"), rows)
    return f"{table}\n\n{_summary(record)}, {where}.\n"
