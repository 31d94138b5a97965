"""Names and colours that figures, tables and pages share."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axis import Axis

__all__ = ["ACCENT", "INK", "OURS", "QUIET", "SAFE", "full_name", "plain_log"]

INK, QUIET, ACCENT = "#1a1a1a", "#6b6b6b", "#0a6e5c"
# Told apart by readers of every kind of colour vision (Okabe and Ito 2008): blue, orange, vermilion, green.
SAFE = ("#0072b2", "#e69f00", "#d55e00", "#009e73")
OURS = "polysplat"
NAMES = {
    "fdk": "FDK (the standard)",
    "fdk-water": "FDK after water correction",
    "mono": "Gaussians, one energy",
    OURS: "tomo-polysplat",
}


def plain_log(axis: Axis) -> None:
    """A logarithmic axis with ticks such as 0.5, 1 and 2; a narrow range, which has none of these, keeps its own."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    (axis.axes.set_xscale if axis is axis.axes.xaxis else axis.axes.set_yscale)("log")
    low, high = axis.get_view_interval()
    plain = FuncFormatter(lambda value, _: f"{value:g}")
    axis.set_major_formatter(plain)
    if high > 4 * low:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 1e3 * low else (1.0,)))
        axis.set_minor_locator(NullLocator())
    else:
        axis.set_minor_formatter(plain)


def full_name(name: str) -> str:
    """What a method is called in front of people."""
    return NAMES.get(name, name)
