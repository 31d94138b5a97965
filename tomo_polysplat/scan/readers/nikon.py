"""Nikon (X-Tek): an .xtekct file, TIFFs with one white level, and the measured angles.

The sense of rotation, the side from which the pictures are seen and the signs of ``ObjectOffsetX``, ``ObjectRoll``,
``ObjectTilt`` and ``DetectorOffsetX`` are those that the reader of the Core Imaging Library has found.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail, require_number
from tomo_polysplat.physics.filter_text import filters_of
from tomo_polysplat.scan.readers.acquisition import Acquisition, Guess, Setup, Tube
from tomo_polysplat.scan.readers.entries import entries_of
from tomo_polysplat.scan.readers.files_of_scans import the_one
from tomo_polysplat.scan.readers.frames import TiffFrames
from tomo_polysplat.scan.readers.ini_text import IniText
from tomo_polysplat.scan.readers.picture_names import gaps_in, has_word, in_order, numbers_of, tiffs_in
from tomo_polysplat.scan.readers.stated import require_known, stated_over
from tomo_polysplat.scan.readers.text import NUMBER, text_of

__all__ = ["KIND", "read", "recognises"]

KIND = "Nikon (.xtekct)"
# Degrees by which measured angles may be off the even steps before they are believed instead.
_EVEN = 0.5
_MOST_BYTES = 1 << 24


def recognises(path: Path) -> bool:
    """Whether it is an .xtekct file or a folder with one."""
    return bool(_texts(path))


def read(path: Path, stated: Mapping[str, Any]) -> Acquisition:
    """See `tomo_polysplat.load_scan`; `stated` has its ``scanner``."""
    file = the_one(_texts(path), remedy="name its .xtekct file")
    folder, text = file.parent, IniText(file)
    name = text.text("Name", otherwise=file.stem)
    files = _pictures(folder, text, name)
    frames, numbers = TiffFrames(files), numbers_of(files)
    expected = int(text.number("Projections", otherwise=frames.shape[0]))
    said = []
    if frames.shape[0] != expected:
        said.append(f"{frames.shape[0]} pictures are there, the .xtekct tells of {expected}")
    if gaps := gaps_in(files):
        said.append(f"the numbers of the pictures jump ({gaps}): each keeps the angle of its number")
    _require_size(text, frames)
    setup, more = _setup(text, folder, np.arange(len(files)) if numbers is None else numbers)
    tube, unclear = _tube(text)
    told = Acquisition(
        KIND,
        frames,
        setup,
        name=name,
        white=text.number("WhiteLevel", otherwise=0.0) or None,
        # White is corrected to a level below the largest number: air may be brighter.
        saturates=False,
        from_detector=True,
        tube=tube,
    ).saying(*said, *more, *unclear)
    told = stated_over(told, require_known(stated, "scanner"), folder)
    return replace(told, other=text.others())


def _texts(path: Path) -> list[Path]:
    files = [path] if path.is_file() else entries_of(path)
    return sorted(file for file in files if file.suffix.lower() == ".xtekct" and file.is_file())


def _pictures(folder: Path, text: IniText, name: str) -> list[Path]:
    """TIFFs of that name and a number: in the folder, in the one that the text names, or in one called projections."""
    inner = folder / Path(text.text("InputFolderName").replace("\\", "/")).name
    # One of the scan's own name holds the slices, as Inspect-X writes them.
    within = [place for place in entries_of(folder) if has_word(place.name, "projections")]
    tiffs = [tiffs_in(place) for place in (folder, inner, *within) if place.is_dir()]
    named = [[f for f in some if re.fullmatch(rf"{re.escape(name)}_*\d+", f.stem, re.I)] for some in tiffs]
    numbered = [[f for f in some if re.search(r"\d+$", f.stem)] for some in tiffs]
    rest = [
        [f for f in some if not (has_word(f.stem, "flats") or has_word(f.stem, "darks"))] for some in numbered
    ]
    if found := next((some for some in (*named, *rest) if some), None):
        return in_order(found)
    raise fail("path", f"TIFFs named {name}_0001.tif and so on", f"none in {folder}")


def _require_size(text: IniText, frames: TiffFrames) -> None:
    """Refuse pictures that are not of the detector's pixels: whether they were binned or cut out, nothing tells."""
    rows, columns = frames.shape[1:]
    told = [text.number(f"DetectorPixels{axis}", otherwise=size) for axis, size in zip("YX", (rows, columns))]
    if told == [rows, columns]:
        return
    expected = f"pictures of {told[0]:g} x {told[1]:g} pixels, as DetectorPixelsY and DetectorPixelsX say"
    remedy = "write the size and the pixel of these pictures into the .xtekct; of those cut out, also DetectorOffset"
    raise fail("path", expected, f"{rows} x {columns}", remedy)


def _setup(text: IniText, folder: Path, numbers: np.ndarray) -> tuple[Setup, list[str]]:
    """Of pictures of these numbers, from 0 on."""
    near, far = text.number("SrcToObject"), text.number("SrcToDetector")
    require_number("SrcToDetector", far, above=0.0)
    pixel = (text.number("DetectorPixelSizeX"), text.number("DetectorPixelSizeY"))
    height = pixel[1] * text.number("DetectorPixelsY", otherwise=0.0)
    top, bottom = (text.number(f"CentreOfRotation{end}", otherwise=0.0) for end in ("Top", "Bottom"))
    aside = text.number("ObjectOffsetX", otherwise=0.5 * (top + bottom) * near / far)
    leaning = -np.degrees(np.arctan2(top - bottom, height)) if height else 0.0
    roll = text.number("ObjectRoll", otherwise=float(leaning))
    said: list[str] = []
    if "ObjectOffsetX" not in text and not (top or bottom):
        axis = "no centre of rotation: the axis is taken to fall on the detector's middle; give offset= otherwise"
        said.append(Guess(axis, "offset"))
    right, up = (text.number(f"DetectorOffset{axis}", otherwise=0.0) for axis in "XY")
    tilt = text.number("ObjectTilt", otherwise=0.0)
    degrees, more = _degrees(text, folder, numbers)
    setup = Setup(degrees, pixel, near, far, (-right, up), roll=roll, axis=-aside, tilt=tilt)
    return setup, said + more


def _degrees(text: IniText, folder: Path, numbers: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Even steps, unless angles were measured that differ from them; the steps tell the sense."""
    said: list[str] = []
    if "AngularStep" not in text:
        turn = f"no AngularStep: {numbers[-1] + 1} views are taken to make one full turn"
        said.append(Guess(turn, "arc", "degrees"))
    step = text.number("AngularStep", otherwise=360.0 / (numbers[-1] + 1))
    start = text.number("InitialAngle", otherwise=0.0)
    even = step * numbers
    for file in _angle_files(folder):
        measured = _measured(file)
        if len(measured) <= numbers[-1]:
            said.append(
                f"{file.name} has {len(measured)} angles for {len(numbers)} pictures: even steps are taken"
            )
            break
        from_first = np.rad2deg(np.unwrap(np.deg2rad(measured[numbers])))
        from_first -= from_first[0]
        if from_first[-1] * even[-1] < 0:
            from_first = -from_first
        if np.abs(from_first - even).max() > _EVEN:
            return start + from_first, said
        break
    return start + even, said


def _angle_files(folder: Path) -> list[Path]:
    files = [file for file in entries_of(folder) if file.is_file()]
    tables = [file for file in files if file.name.lower().endswith("_ctdata.txt")]
    return tables + [file for file in files if file.suffix.lower() == ".ang"]


def _measured(file: Path) -> np.ndarray:
    """The second number of each line that begins with the number of a picture, after the last line of words."""
    found: list[tuple[int, float]] = []
    for line in text_of(file, _MOST_BYTES).splitlines():
        match = re.match(rf"\s*(\d{{1,9}})\s*[:;\s,]\s*({NUMBER})(?![.,\d])", line)
        if match is not None:
            found.append((int(match[1]), float(match[2].replace(",", "."))))
        elif line.strip():
            # A head of words and numbers stands before the words above the columns.
            found = []
    return np.array([angle for _, angle in sorted(found)])


def _tube(text: IniText) -> tuple[Tube, list[str]]:
    """The tube, and what is unclear about its filter."""
    kvp = text.number("XraykV", otherwise=0.0) or None
    material, told = text.text("Filter_Material"), text.text("Filter_ThicknessMM")
    size = text.number("Filter_ThicknessMM", otherwise=0.0)
    if material.lower() == "none" or (told and size == 0):
        return Tube(kvp, {}), []
    if material and not told:
        unclear = f"a filter of {material} without its thickness: give filter='{material} ...mm'"
        return Tube(kvp), [Guess(unclear, "filter")]
    return Tube(kvp, filters_of(f"{material} {size}mm") if material else None), []
