"""Filters as scanners write them: "Al 1.0mm", "0.5 mm Cu", "Al 0.5mm + Cu 0.04mm", "No Filter"."""

from __future__ import annotations

import re

from tomo_polysplat.physics.materials import composition
from tomo_polysplat.units import CM_PER_UNIT

__all__ = ["filters_of"]

_NUMBER = r"(?P<size>\d+(?:[.,]\d+)?)\s*(?P<unit>mm|um|µm|cm)"
_NAME = r"(?P<name>[A-Za-z][A-Za-z ]*?)"
_EITHER = (re.compile(rf"{_NAME}\s*[:=]?\s*{_NUMBER}"), re.compile(rf"{_NUMBER}\s*(?:of\s+)?{_NAME}"))
_NONE = ("", "no filter", "none", "no", "open", "off", "without", "air")


def filters_of(text: str) -> dict[str, float] | None:
    """Material and thickness in cm; empty for no filter, None where the text does not tell.

    Parameters
    ----------
    text : str
        One or more filters, joined by ``+``, ``;``, ``&`` or ``and``.
    """
    plain = text.strip().strip('"').lower()
    if plain in _NONE:
        return {}
    found: dict[str, float] = {}
    for one in re.split(r"\s*(?:\+|;|&|\band\b)\s*", text.strip().strip('"')):
        match = next((m for pattern in _EITHER if (m := pattern.fullmatch(one.strip()))), None)
        if match is None:
            return None
        name, unit = match["name"].strip(), match["unit"].replace("µ", "u")
        try:
            composition(name)
        except ValueError:
            return None
        size = float(match["size"].replace(",", ".")) * CM_PER_UNIT[unit]
        found[name] = found.get(name, 0.0) + size
    return found
