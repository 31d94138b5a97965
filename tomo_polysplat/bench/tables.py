"""Figures of repeated runs as tables: as text, as Markdown, as HTML."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from statistics import fmean, stdev
from typing import Any

__all__ = ["Column", "cell", "grouped", "html_table", "markdown_table", "text_table"]

Column = tuple[str, str, str]
"""Key of a record, heading, and how a number is written."""

Rows = Sequence[Sequence[str]]


def grouped(runs: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> list[list[Mapping[str, Any]]]:
    """Runs that agree in these keys, together, in the order in which they first appear."""
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for run in runs:
        groups.setdefault(tuple(run[key] for key in keys), []).append(run)
    return list(groups.values())


def cell(runs: Sequence[Mapping[str, Any]], key: str, form: str) -> str:
    """The mean over repeated runs, with the sample standard deviation where there are several; else a dash."""
    known = [run[key] for run in runs if run.get(key) is not None]
    if not known:
        return "–"
    mean = form.format(fmean(known))
    return mean if len(known) == 1 else f"{mean} ± {form.replace('+', '').format(stdev(known))}"


def text_table(headings: Sequence[str], rows: Rows) -> str:
    """In columns of characters, the first to the left."""
    lines = [headings, *rows]
    widths = [max(len(line[place]) for line in lines) for place in range(len(headings))]
    return "\n".join(
        "  ".join(
            [line[0].ljust(widths[0]), *(text.rjust(width) for text, width in zip(line[1:], widths[1:]))]
        ).rstrip()
        for line in lines
    )


def markdown_table(headings: Sequence[str], rows: Rows) -> str:
    """As GitHub reads it."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(text.replace("|", "\\|") for text in line) + " |" for line in lines)


def html_table(headings: Sequence[str], rows: Rows) -> str:
    """For a page of ``report.html``."""

    def line(tag: str, cells: Sequence[str]) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(text)}</{tag}>" for text in cells) + "</tr>"

    return "<table>" + line("th", headings) + "".join(line("td", row) for row in rows) + "</table>"
