"""Filters as people and scanners write them: "Al 1.0mm", "0.5 mm Cu", "Al 0.5mm + Cu 0.04mm", "No Filter"."""

from __future__ import annotations

import logging
import re

from tomo_polysplat.checks import fail
from tomo_polysplat.physics.materials import composition
from tomo_polysplat.units import CM_PER_UNIT

__all__ = ["FILTER_REMEDY", "filters_of", "require_filters"]

logger = logging.getLogger(__name__)

FILTER_REMEDY = (
    "write a material and its thickness with a unit, such as 'Al 1mm' or 'Al 0.5mm + Cu 0.1mm', or 'none'"
)
_NUMBER = r"(?P<size>\d+(?:[.,]\d+)?)\s*(?P<unit>mm|um|[µ\u03bc]m|cm)"
_NAME = r"(?P<name>[A-Za-z][A-Za-z0-9 ]*?)"
_EITHER = (re.compile(rf"{_NAME}\s*[:=]?\s*{_NUMBER}"), re.compile(rf"{_NUMBER}\s*(?:of\s+)?{_NAME}"))
_BARE = re.compile(r"(?P<name>[^:]+):(?P<size>[^:]+)")
_NONE = ("", "no filter", "none", "no", "open", "off", "without", "air")
# In cm: thicker ones without a unit were probably meant in mm.
_THICK = 0.3


def filters_of(text: str) -> dict[str, float] | None:
    """Material and thickness in cm; empty for no filter, None where the text does not tell.

    Parameters
    ----------
    text : str
        One or more filters, joined by ``+``, ``;``, ``&``, ``/``, a comma or ``and``.
    """
    plain = text.strip().strip('"').lower()
    if plain in _NONE:
        return {}
    found: dict[str, float] = {}
    for one in _apart(text):
        match = next((m for pattern in _EITHER if (m := pattern.fullmatch(one))), None)
        if match is None:
            return None
        name, unit = match["name"].strip(), match["unit"].replace("µ", "u").replace("\u03bc", "u")
        try:
            composition(name)
        except ValueError:
            return None
        size = float(match["size"].replace(",", ".")) * CM_PER_UNIT[unit]
        found[name] = found.get(name, 0.0) + size
    return found


def require_filters(argument: str, text: str) -> dict[str, float]:
    """Material and thickness in cm of what a user writes; ``Al:0.1``, without a unit, is in cm.

    Raises
    ------
    ValueError
        For what is no filter, and for an unknown material.
    """
    found: dict[str, float] = {}
    for one in _apart(text):
        filters = filters_of(one) if one else None
        if filters is None:
            filters = _in_cm(argument, one)
        for name, size in filters.items():
            found[name] = found.get(name, 0.0) + size
    return found


def _apart(text: str) -> list[str]:
    # A comma before a digit is a decimal sign.
    plain = re.sub(r"[()]|\bfilter\s*$", " ", text.strip().strip('"'), flags=re.I)
    return [one.strip() for one in re.split(r"\s*(?:\+|;|&|/|,(?!\d)|\band\b)\s*", plain)]


def _in_cm(argument: str, one: str) -> dict[str, float]:
    match = _BARE.fullmatch(one)
    known = match or next((m for pattern in _EITHER if (m := pattern.fullmatch(one))), None)
    if known is not None:
        _require_material(argument, known["name"].strip(), one)
    try:
        size = float(match["size"]) if match else -1.0
    except ValueError:
        size = -1.0
    if match is None or not 0 <= size < float("inf"):
        raise fail(argument, "a material and its thickness", repr(one), FILTER_REMEDY)
    name = match["name"].strip()
    if size >= _THICK:
        logger.warning(
            "The filter %s is taken to be %g cm thick, as numbers without a unit are: write %s %gmm if it is %g mm.",
            *(one, size, name, size, size),
        )
    return {name: size}


def _require_material(argument: str, name: str, one: str) -> None:
    try:
        composition(name)
    except ValueError as error:
        raise fail(argument, "a known material", f"{one!r} ({error})") from None
