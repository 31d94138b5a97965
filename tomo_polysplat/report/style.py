"""Names and colours that figures, tables and pages share."""

from __future__ import annotations

__all__ = ["ACCENT", "INK", "OURS", "QUIET", "full_name"]

INK, QUIET, ACCENT = "#1a1a1a", "#6b6b6b", "#0a6e5c"
OURS = "polysplat"
NAMES = {
    "fdk": "FDK (the standard)",
    "fdk-water": "FDK after water correction",
    "mono": "Gaussians, one energy",
    OURS: "tomo-polysplat",
}


def full_name(name: str) -> str:
    """What a method is called in front of people."""
    return NAMES.get(name, name)
