"""Scans of the ESRF before HDF5: EDF pictures that are numbered after the folder, and an .info text beside them.

Names and units are those of the ESRF's own reader (tomoscan): ``PixelSize`` in um, ``refHST0000.edf`` a picture without
the object, ``dark.edf`` one without light, ``darkend0000.edf`` the sum of ``DARK_N`` of them; after ``TOMO_N`` views
come pictures of the way back, which are left out. Pictures are taken as those of an NXtomo file, which the ESRF writes
today.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from tomo_polysplat.checks import fail, require_number
from tomo_polysplat.scan.readers.acquisition import Acquisition, Guess, Setup
from tomo_polysplat.scan.readers.edf import EdfFrames
from tomo_polysplat.scan.readers.entries import entries_of
from tomo_polysplat.scan.readers.files_of_scans import the_one
from tomo_polysplat.scan.readers.frames import Frames, MeanOfSums
from tomo_polysplat.scan.readers.ini_text import IniText
from tomo_polysplat.scan.readers.picture_names import gaps_in, in_order, numbers_of
from tomo_polysplat.scan.readers.stated import require_known, stated_over
from tomo_polysplat.scan.readers.text import text_of

__all__ = ["KIND", "read", "recognises"]

KIND = "ESRF (.info, EDF)"
_START_BYTES = 4096
# The first kind that is there is taken: medians before those that were summed up or averaged, then single pictures.
_FLATS = (r"refhst\d*", r"ref\d+_\d+")
_DARKS = (r"dark(hst)?", r"darkend\d*")
_SUMMED = re.compile("darkend", re.I)


def recognises(path: Path) -> bool:
    """Whether it is such an .info file or a folder with one."""
    return bool(_texts(path))


def read(path: Path, stated: Mapping[str, Any]) -> Acquisition:
    """See `tomo_polysplat.load_scan`; `stated` has its ``scanner``."""
    file = the_one(_texts(path), remedy="name its .info file")
    folder, text, known = file.parent, IniText(file), require_known(stated, "scanner")
    planned = int(require_number("TOMO_N", text.number("TOMO_N"), at_least=1))
    files = _views(folder, file.stem.rstrip("_"))
    counted = numbers_of(files)
    if counted is None:
        got = f"{files[0].name} to {files[-1].name}"
        raise fail("path", "EDF pictures of one name, numbered one after the other", got)
    numbers = counted[counted < planned]
    kept = files[: len(numbers)]
    frames = EdfFrames(kept)
    said: list[str] = []
    if len(kept) < planned:
        said.append(f"{len(kept)} pictures are there, the .info tells of {planned}")
    if gaps := gaps_in(kept):
        said.append(f"the numbers of the pictures jump ({gaps}): each keeps the angle of its number")
    pixel = text.number("PixelSize", otherwise=0.0) / 1000
    setup = Setup(numbers * (text.number("ScanRange", otherwise=180.0) / planned), pixel or 1.0)
    told = Acquisition(KIND, frames, setup, name=file.stem, unit="mm" if pixel > 0 else "pixel")
    told = replace(told, exposure=text.number("Count_time", otherwise=0.0) or None)
    flats, darks = (_beside(folder, patterns) for patterns in (_FLATS, _DARKS))
    told = replace(told, flats=EdfFrames(flats) if flats else None, darks=_dark(darks, text))
    if told.unit == "pixel":
        said.append(Guess("the pixel is not known: lengths are in pixels; give pixel=", "pixel"))
    beam = "the beam is taken to be parallel; give source_object= and source_detector= if it is not"
    said.append(Guess(beam, "beam", "source_object", "source_detector"))
    axis = "the axis is taken to fall on the detector's middle; give offset= if it does not"
    said.append(Guess(axis, "offset"))
    if flats and not darks:
        dark = "no dark pictures: without light a pixel is taken to count 0; give darks= if it does not"
        said.append(Guess(dark, "darks"))
    told = stated_over(told.saying(*said), known, folder)
    return replace(told, other=text.others())


def _texts(path: Path) -> list[Path]:
    inside = [path] if path.is_file() else entries_of(path)
    named = [file for file in inside if file.suffix.lower() == ".info" and file.is_file()]
    return [file for file in named if _is_scan(file)]


def _is_scan(file: Path) -> bool:
    with open(file, "rb") as stream:
        return bool(re.search(r"(?mi)^\s*tomo_n\s*=", text_of(stream.read(_START_BYTES), _START_BYTES)))


def _views(folder: Path, name: str) -> list[Path]:
    """Pictures of the scan's name and a number."""
    named = re.compile(rf"{re.escape(name)}_*\d+\.edf", re.I)
    files = [file for file in entries_of(folder) if named.fullmatch(file.name)]
    if not files:
        raise fail("path", f"EDF pictures named {name}0000.edf and so on", f"none in {folder}")
    return in_order(files)


def _dark(files: list[Path], text: IniText) -> Frames | None:
    """Pictures without light; those of the scan's end are each the sum of ``DARK_N``."""
    if not files:
        return None
    frames = EdfFrames(files)
    if not _SUMMED.match(files[0].name):
        return frames
    return MeanOfSums(frames, int(require_number("DARK_N", text.number("DARK_N", otherwise=1.0), at_least=1)))


def _beside(folder: Path, patterns: tuple[str, ...]) -> list[Path]:
    for pattern in patterns:
        files = [file for file in entries_of(folder) if re.fullmatch(rf"{pattern}\.edf", file.name, re.I)]
        if files:
            return in_order(files)
    return []
