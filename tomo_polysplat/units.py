"""Units of length. Materials are tabulated in cm, scans come in whatever their geometry is in."""

from __future__ import annotations

import logging
import math
import re
from typing import NamedTuple

from tomo_polysplat.checks import fail

__all__ = ["LENGTH_UNITS", "Doubt", "cm_per", "density_in_doubt", "length_in_cm", "warn_of_unit"]

logger = logging.getLogger(__name__)

CM_PER_UNIT = {"m": 100.0, "cm": 1.0, "mm": 0.1, "um": 1e-4}

LENGTH_UNITS = (*CM_PER_UNIT, "pixel")
# What else makes rays of metal look so.
_ALIKE = "so do rays that were corrected for hardening, and a spectrum that lacks a filter"
# Densities of water that attenuates as an object's main matter does, in g/cm3: what needs no question; what nobody
# scans (foams have 0.015; aerogels have 0.003, but through centimetres of those no light is lost); and what no solid
# attenuates like (gold: 280).
_ORDINARY, _NOTHING, _DENSEST = (0.3, 10.0), 0.005, 600.0


def cm_per(unit: str) -> float:
    """Centimetres in one `unit`: multiply a value in 1/cm by it to have it in 1/`unit`.

    Raises
    ------
    ValueError
        For an unknown unit, and for ``"pixel"``, whose size nobody has stated.
    """
    if unit == "pixel":
        raise fail(
            "unit",
            "a unit of length",
            "'pixel'",
            "a spectrum needs real lengths: give the pixel size, or reconstruct without a spectrum",
        )
    if unit not in CM_PER_UNIT:
        raise fail("unit", f"one of {', '.join(LENGTH_UNITS)}", repr(unit))
    return CM_PER_UNIT[unit]


def warn_of_unit(unit: str) -> None:
    """Say which unit lengths are taken to be in, where nobody has told."""
    logger.warning(
        "No unit of length was given: lengths are taken to be in %s. Attenuations and densities are wrong by as much "
        "as it is: pass unit='%s', or 'mm', 'um' or 'm' (--unit).",
        *(unit, unit),
    )


class Doubt(NamedTuple):
    """Of the unit of length.

    Attributes
    ----------
    words : str
        What the object looks like, and in which unit it would be ordinary.
    remedy : str
    impossible : bool
        Whether no matter is like that.
    """

    words: str
    remedy: str
    impossible: bool


def density_in_doubt(level: float, unit: str, light: bool = False) -> Doubt | None:
    """Whether an object that attenuates like water of `level` g/cm3, in this unit, may be one of another unit.

    Metal, of which a wrong unit of ordinary matter may make none, is not doubted, unless it hardens the beam as light
    matter does (``light``), which is never so dense.
    """
    if not level > 0 or (_ORDINARY[0] <= level <= _DENSEST and not light):
        return None
    impossible = not _NOTHING <= level <= _DENSEST
    like = f"in {unit} the object attenuates like water of {level:.2g} g/cm3"
    if impossible:
        like += ", which no matter does"
    elif light:
        like += f", but hardens the beam as light matter does ({_ALIKE})"
    elif level < 1:
        like += ", as foam does"
    others = {name: level * CM_PER_UNIT[unit] / size for name, size in CM_PER_UNIT.items() if name != unit}
    others = {name: it for name, it in others.items() if _ORDINARY[0] <= it <= _ORDINARY[1]}
    middle = math.sqrt(math.prod(_ORDINARY))
    best = min(others, key=lambda name: abs(math.log(others[name] / middle)), default=None)
    times = f"{10.0 ** abs(round(math.log10(level))):g} times too {'large' if level < 1 else 'small'}"
    if best is None:
        return Doubt(like, f"look at the unit and the pixel's size: lengths seem {times}", impossible)
    remedy = f"pass unit='{best}' (--unit {best}) if that is meant, or mend the size of the pixel"
    return Doubt(f"{like}; in {best} like {others[best]:.2g}", remedy, impossible)


def length_in_cm(argument: str, text: str) -> float:
    """A length with its unit, such as ``"0.6mm"``, in cm; a number alone is in cm.

    Raises
    ------
    ValueError
        For what is no length.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(m|cm|mm|um|µm)?\s*", text)
    if match is None:
        raise fail(argument, "a length", repr(text), "such as 0.6mm")
    return float(match[1]) * CM_PER_UNIT[(match[2] or "cm").replace("µ", "u")]
