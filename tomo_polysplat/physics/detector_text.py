"""Detectors as people name them: "csi:0.6mm", "gos:0.2mm", "cdte:1mm:20kev", "counting"."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

from tomo_polysplat.checks import did_you_mean, fail
from tomo_polysplat.units import length_in_cm

__all__ = ["DETECTOR_NAMES", "detector_parts"]


class _Kind(NamedTuple):
    """What absorbs the photons, how thick it usually is in cm, and whether its signal is the energy."""

    sensor: str
    usual_cm: float
    integrating: bool


DETECTOR_NAMES = {
    "csi": _Kind("CsI", 0.06, True),
    "gos": _Kind("gadolinium oxysulfide", 0.02, True),
    "luag": _Kind("lutetium aluminium garnet", 0.01, True),
    "yag": _Kind("yttrium aluminium garnet", 0.01, True),
    "cdwo4": _Kind("cadmium tungstate", 0.1, True),
    "silicon": _Kind("Si", 0.03, False),
    "cdte": _Kind("cadmium telluride", 0.1, False),
    "gaas": _Kind("gallium arsenide", 0.05, False),
}
_OTHER_NAMES = {
    "si": "silicon",
    "gadox": "gos",
    "caesium iodide": "csi",
    "cesium iodide": "csi",
    "panel": "csi",
}
_WAYS = {"counting": False, "integrating": True}
_REMEDY = "such as csi:0.6mm, gos:0.2mm or cdte:1mm; counting:MATERIAL:0.5mm or integrating:MATERIAL:0.5mm for others"


def detector_parts(argument: str, text: str) -> dict[str, Any]:
    """The fields of a `Detector` that is named by its sensor, thickness and threshold, with colons between.

    Parameters
    ----------
    argument : str
        For errors.
    text : str
        ``NAME``, ``NAME:THICKNESS`` or, of one that counts, ``NAME:THICKNESS:KEV``, of `DETECTOR_NAMES`; the same
        after ``counting:`` or ``integrating:`` for any material; or one of these words alone, for a detector that
        absorbs all. After these words a thickness without a unit is in cm. Without a thickness it is the usual one.

    Raises
    ------
    ValueError
        For another text.
    """
    words = [word.strip() for word in text.split(":")]
    way = _WAYS.get(words[0].lower())
    if way is not None:
        words = words[1:]
        if not words:
            return {"integrating": way}
    name = _OTHER_NAMES.get(words[0].lower(), words[0].lower())
    kind = DETECTOR_NAMES.get(name)
    if kind is None and (way is None or len(words) < 2):
        meant = did_you_mean(words[0], [*DETECTOR_NAMES, *_OTHER_NAMES, *_WAYS])
        known = f"counting, integrating, or one of {', '.join(DETECTOR_NAMES)} with its thickness"
        raise fail(argument, known, repr(text), meant or _REMEDY)
    integrating = way if way is not None else kind.integrating  # type: ignore[union-attr]
    if len(words) > (2 if integrating else 3):
        raise fail(argument, "NAME:THICKNESS", repr(text), _REMEDY)
    if way is None and len(words) > 1 and words[1][-1:].isdigit():
        raise fail(argument, "a thickness with its unit", repr(text), f"write {words[0]}:{words[1]}mm or cm")
    thickness = kind.usual_cm if kind and len(words) < 2 else length_in_cm(argument, words[1])
    parts = {
        "integrating": integrating,
        "sensor": kind.sensor if kind else words[0],
        "thickness_cm": thickness,
    }
    return parts if len(words) < 3 else parts | {"threshold_kev": _kev(argument, words[2])}


def _kev(argument: str, text: str) -> float:
    match = re.fullmatch(r"(\d+(?:\.\d*)?)\s*(?:kev)?", text.lower())
    if match is None:
        raise fail(argument, "a threshold in keV", repr(text), "such as cdte:1mm:20kev")
    return float(match[1])
