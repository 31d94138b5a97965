"""Units of length. Materials are tabulated in cm, scans come in whatever their geometry is in."""

from __future__ import annotations

import logging
import re

from tomo_polysplat.checks import fail

__all__ = ["LENGTH_UNITS", "cm_per", "length_in_cm", "warn_of_unit"]

logger = logging.getLogger(__name__)

CM_PER_UNIT = {"m": 100.0, "cm": 1.0, "mm": 0.1, "um": 1e-4}

LENGTH_UNITS = (*CM_PER_UNIT, "pixel")


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
