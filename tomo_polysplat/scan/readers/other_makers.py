"""Texts of scanners that are not read: where their angles and their axis count from is not published.

What they tell without doubt becomes options of ``tomo-polysplat import``, which whoever meets the refusal can copy.
"""

from __future__ import annotations

import re
from pathlib import Path

from tomo_polysplat.scan.readers.entries import entries_of
from tomo_polysplat.scan.readers.text import number_of, text_of

__all__ = ["what_is_told"]

_MOST_BYTES, _MOST_FILES = 1 << 22, 200
_N = r"([-+\d.,eE]+)"
# Of each maker: the ending, a word in the text, and what is found how. {element} is that of a line or of an XML tag.
_MAKERS = {
    "GE phoenix": (
        ".pca",
        "[Geometry]",
        {
            "sod": rf"(?m)^\s*FOD\s*=\s*{_N}",
            "sdd": rf"(?m)^\s*FDD\s*=\s*{_N}",
            "voxel": rf"(?m)^\s*VoxelSizeX\s*=\s*{_N}",
            "angles": rf"(?m)^\s*RotationSector\s*=\s*{_N}",
            "white": rf"(?m)^\s*FreeRay\s*=\s*{_N}",
            "kvp": rf"(?m)^\s*Voltage\s*=\s*{_N}",
        },
    ),
    "Diondo": (
        ".xml",
        "<SourceDetectorDist>",
        {
            "sod": rf"<SourceObjectDist>\s*{_N}",
            "sdd": rf"<SourceDetectorDist>\s*{_N}",
            "pixel": rf"<ProjectionPixelSizeX>\s*{_N}",
        },
    ),
    "Yxlon": (
        ".xml",
        "ConeBeamScanParameter",
        {
            # These two are in pixels.
            "sod pixels": rf"<Fod>\s*{_N}",
            "sdd pixels": rf"<Fdd>\s*{_N}",
            "pixel": rf"<PixelPitch>\s*{_N}",
            "angles": rf"<Rotation>\s*{_N}",
        },
    ),
    "RX Solutions": (
        ".xml",
        "<unireconstruction",
        {
            "sod": rf"<geometry\b[^>]*\bsod=\"{_N}\"",
            "sdd": rf"<geometry\b[^>]*\bsdd=\"{_N}\"",
            "kvp": rf"<xray\b[^>]*\bvoltage=\"{_N}\"",
        },
    ),
}
_ORDER = ("sod", "sdd", "pixel", "angles", "white", "kvp")


def what_is_told(path: Path) -> tuple[str, str] | None:
    """The file and its maker, and the options that say the same; None where there is no such text.

    Parameters
    ----------
    path : Path
        A folder, or one of its files.
    """
    inside = entries_of(path)[:_MOST_FILES] if path.is_dir() else [path]
    endings = {ending for ending, _, _ in _MAKERS.values()}
    for file in (file for file in inside if file.is_file() and file.suffix.lower() in endings):
        if file.stat().st_size > _MOST_BYTES:
            continue
        text = text_of(file, _MOST_BYTES)
        for maker, (ending, word, patterns) in _MAKERS.items():
            if file.suffix.lower() == ending and word in text:
                return f"{file.name} of {maker}", _options(_numbers(text, patterns))
    return None


def _numbers(text: str, patterns: dict[str, str]) -> dict[str, float]:
    found = {}
    for name, pattern in patterns.items():
        match = re.search(pattern, text)
        number = number_of(match[1]) if match else None
        if number is not None:
            found[name] = float(number)
    return found


def _options(told: dict[str, float]) -> str:
    known = dict(told)
    for name in ("sod", "sdd"):
        if f"{name} pixels" in told and "pixel" in told:
            known[name] = told[f"{name} pixels"] * told["pixel"]
    if "voxel" in told and told.get("sod", 0.0) > 0 and "sdd" in told:
        # Binned or not, the voxel is that of the pictures.
        known["pixel"] = told["voxel"] * told["sdd"] / told["sod"]
    known.setdefault("angles", 360.0)
    lengths = [f"--{name} {known[name]:.6g}" if name in known else f"--{name} ..." for name in _ORDER[:3]]
    return " ".join([*lengths, *(f"--{name} {known[name]:g}" for name in _ORDER[3:] if name in known)])
