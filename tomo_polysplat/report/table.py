"""The table of methods against seconds and errors: as text, in a figure, on a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from tomo_polysplat.report.style import ACCENT, INK, OURS, QUIET, full_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Table", "as_text", "cells", "draw", "headings", "is_best"]

Table = Sequence[Mapping[str, Any]]

# key, heading, how to write a number
COLUMNS = (
    ("seconds", "seconds", "{:.1f}"),
    ("psnr", "PSNR without metal (dB)", "{:.1f}"),
    ("psnr_all", "PSNR everywhere (dB)", "{:.1f}"),
    ("ssim", "SSIM", "{:.3f}"),
    ("rmse", "rms error ({unit})", "{:.4f}"),
)
PLACES = (0.0, 0.36, 0.54, 0.71, 0.80, 0.93)  # in a figure: the left edge of names, the right edge of numbers


def headings(unit: str) -> list[str]:
    """Headings for lengths in `unit`."""
    return ["method", *(heading.format(unit=f"1/{unit}") for _, heading, _ in COLUMNS)]


def cells(entry: Mapping[str, Any]) -> list[str]:
    """What one method's row says; a dash where a number is missing."""
    numbers = [form.format(entry[key]) if entry.get(key) is not None else "–" for key, _, form in COLUMNS]
    return [full_name(entry["name"]), *numbers]


def is_best(table: Table, entry: Mapping[str, Any], column: int) -> bool:
    """Whether a method has the smallest or largest error measure of a column (seconds do not compete)."""
    if column < 2:
        return False
    key = COLUMNS[column - 1][0]
    known = [other[key] for other in table if other.get(key) is not None]
    best = (min if key == "rmse" else max)(known, default=None)
    return best is not None and entry.get(key) == best


def as_text(table: Table, unit: str) -> str:
    """The table in columns of characters."""
    lines = [headings(unit), *(cells(entry) for entry in table)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    first, *rest = widths
    return "\n".join(
        "  ".join([line[0].ljust(first), *(text.rjust(width) for text, width in zip(line[1:], rest))])
        for line in lines
    )


def draw(axis: Axes, table: Table, unit: str) -> None:
    """The table as text in a figure, our method in colour and the best of each error measure in bold."""
    axis.axis("off")
    axis.set(xlim=(0, 1), ylim=(len(table) + 0.4, -0.9))
    axis.axhline(0.2, color=QUIET, linewidth=0.6)
    for place, heading in zip(PLACES, headings(unit)):
        _put(axis, place, -0.3, heading, QUIET, 9, "normal")
    for line, entry in enumerate(table, start=1):
        ours = entry["name"] == OURS
        for column, (place, text) in enumerate(zip(PLACES, cells(entry))):
            bold = is_best(table, entry, column) or (ours and column == 0)
            _put(axis, place, line - 0.2, text, ACCENT if ours else INK, 10, "bold" if bold else "normal")


# What Matplotlib's text takes.
def _put(axis: Axes, x: float, y: float, text: str, colour: str, size: float, weight: str) -> None:
    align = "left" if x == 0 else "right"
    axis.text(x, y, text, ha=align, va="center", fontsize=size, color=colour, fontweight=weight)
