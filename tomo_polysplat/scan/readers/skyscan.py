"""Bruker SkyScan: a .log file, and TIFFs that are named after it.

What the keys mean is as NRecon, the maker's program, uses them: lengths in the object are those of ``Image Pixel
Size`` at ``Object to Source``, binning included; lines are counted from the lowest; ``Postalignment`` is the axis'
shift in columns. Its sign and the sense of rotation are those of the SkyScan parser of the ASTRA Toolbox's tools:
pictures are as seen from the detector, and the object turns counterclockwise seen from above for ``CC``. TIGRE's
reader has the same sense, and counts the lines as here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from itertools import product
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
from tomo_polysplat.scan.readers.text import text_of

__all__ = ["KIND", "read", "recognises"]

KIND = "Bruker SkyScan (.log)"
_START_BYTES = 4096
_ROUND = 0.005
_MOST_DIGITS = 20
# Logs of a reconstruction, which NRecon may write beside the pictures.
_RECONSTRUCTION = re.compile(r".*_rec", re.I)
# From this many mm on a beam is parallel: so tell of synchrotrons and light those who write a log for NRecon.
_PARALLEL = 1e4


def recognises(path: Path) -> bool:
    """Whether it is a SkyScan's .log file or a folder with one."""
    return bool(_logs(path))


def read(path: Path, stated: Mapping[str, Any]) -> Acquisition:
    """See `tomo_polysplat.load_scan`; `stated` has its ``scanner``."""
    file = the_one(_logs(path), remedy="name its .log file")
    folder, log = file.parent, IniText(file)
    prefix = log.text("Filename Prefix")
    if _RECONSTRUCTION.fullmatch(file.stem) and not _RECONSTRUCTION.fullmatch(prefix):
        remedy = f"name the folder of the projections, {prefix}0000.tif and so on"
        raise fail("path", "a scan", f"{file}, the log of a reconstruction", remedy)
    files, said = _counted(_pictures(folder, log, file.stem), log)
    frames = TiffFrames(files)
    _require_size(log, frames)
    numbers = numbers_of(files)
    setup, more = _setup(log, np.arange(len(files)) if numbers is None else numbers, frames.shape[1])
    shift, parts = _postalignment(log, folder)
    width = setup.pixel[0]  # type: ignore[index]
    # Counted from the other side, as the pictures are.
    setup = replace(setup, offset=(-shift * width, setup.offset[1]))
    told = Acquisition(
        KIND,
        frames,
        setup,
        name=(prefix or file.stem).rstrip("_~ "),
        from_detector=True,
        tube=Tube(log.number("Source Voltage (kV)", otherwise=0.0) or None, _filters(log)),
        exposure=log.number("Exposure (ms)", otherwise=0.0) / 1000 or None,
    )
    told = _with_open_beam(told, folder, log, set(files)).saying(*said, *more, *parts, *_drift(log))
    told = stated_over(told, require_known(stated, "scanner"), folder)
    return replace(told, other=log.others())


def _logs(path: Path) -> list[Path]:
    """Logs of scans; of a folder that has none, those of reconstructions, whose pictures will be refused."""
    if path.is_file():
        return [path] if path.suffix.lower() == ".log" and _is_skyscan(path) else []
    every = _all_logs(path)
    return [file for file in every if not _RECONSTRUCTION.fullmatch(file.stem)] or every


def _all_logs(folder: Path) -> list[Path]:
    files = [file for file in entries_of(folder) if file.is_file()]
    return sorted(file for file in files if file.suffix.lower() == ".log" and _is_skyscan(file))


def _is_skyscan(file: Path) -> bool:
    with open(file, "rb") as stream:
        start = text_of(stream.read(_START_BYTES), _START_BYTES).lower()
    return "[acquisition]" in start and "object to source" in start


def _counted(files: list[Path], log: IniText) -> tuple[list[Path], list[str]]:
    """As many of the pictures as the log tells of; what there is to say if they are not so many."""
    expected = int(log.number("Number of Files", otherwise=len(files)))
    said = []
    if len(files) != expected:
        said.append(f"{len(files)} pictures are there, the log tells of {expected}")
    kept = files[:expected] if expected > 0 else files
    if gaps := gaps_in(kept):
        said.append(f"the numbers of the pictures jump ({gaps}): each keeps the angle of its number")
    return kept, said


def _pictures(folder: Path, log: IniText, stem: str) -> list[Path]:
    """The numbered pictures: those of the log's prefix, or of the log's own name where the folder was renamed."""
    tiffs = tiffs_in(folder)
    length = log.number("Filename Index Length", otherwise=4)
    digits = int(require_number("Filename Index Length", length, at_least=0, at_most=_MOST_DIGITS))
    # Another number of digits than the log tells of is what a program that renamed them has left.
    names = [name for name in (log.text("Filename Prefix"), stem) if name]
    for prefix, end in (*product(names, (f"{{{digits}}}", "{3,}")), ("", "{3,}")):
        name = re.compile(rf"{re.escape(prefix)}_*\d{end}" if prefix else rf".*\d{end}", re.I)
        chosen = [file for file in tiffs if name.fullmatch(file.stem)]
        if not prefix:
            chosen = [f for f in chosen if not (has_word(f.stem, "flats") or has_word(f.stem, "darks"))]
        if chosen:
            return in_order(chosen)
    raise fail("path", f"TIFFs named {log.text('Filename Prefix')}{'0' * digits}.tif", f"none in {folder}")


def _require_size(log: IniText, frames: TiffFrames) -> None:
    names = ("Number of Rows", "Number of Columns")
    sizes = [log.number(name, otherwise=size) for name, size in zip(names, frames.shape[1:])]
    if sizes != list(frames.shape[1:]):
        expected = f"pictures of {sizes[0]:g} x {sizes[1]:g} pixels, as the log says"
        got = f"{frames.shape[1]} x {frames.shape[2]}"
        raise fail(
            "path", expected, got, "reconstructed slices are no projections: name the folder of the scan"
        )


def _setup(log: IniText, numbers: np.ndarray, rows: int) -> tuple[Setup, list[str]]:
    """Of pictures of these numbers, but for the axis' shift."""
    near = require_number("Object to Source (mm)", log.number("Object to Source (mm)"), above=0.0)
    parallel = near > _PARALLEL
    far = near if parallel else _camera_distance(log, near)
    object_pixel, said = _pixel(log, far / near)
    if parallel:
        said.append(f"the source is {near:g} mm away: the beam is taken to be parallel")
    # Brought to the detector, where it is the camera's as far as the distances are exact.
    width = object_pixel * far / near
    ratio = log.number("CameraXYRatio", "Camera X/Y Ratio", otherwise=1.0)
    if abs(ratio - 1) > _ROUND:
        wide = (
            f"pixels are taken to be {ratio:g} times as wide as high (CameraXYRatio); give pixel= otherwise"
        )
        said.append(Guess(wide, "pixel"))
    height = width / (ratio if ratio > 0 else 1.0)
    middle = (rows - 1) / 2
    line = log.number("Optical Axis (line)", otherwise=middle)
    if abs(line - middle) == 0.5:
        # An even number of lines has its middle between two, which a whole number cannot tell.
        line = middle
    tilt = log.number("Image Rotation", otherwise=0.0)
    if tilt:
        rolled = (
            f"the camera's rotation of {tilt:g} degrees is not undone; give roll={tilt:g} or roll={-tilt:g}, or "
            "reconstruct with align=True (--align), which finds it"
        )
        said.append(Guess(rolled, "roll"))
    # Of several positions the scanner has put the pictures together.
    together = log.number("Number Of Horizontal Offset Positions", otherwise=1.0) > 1
    if "ON" in log.text("Camera Offset").upper() and not together:
        said.append(
            Guess("the camera was offset: is that in the pictures? give offset= if it is not", "offset")
        )
    sense, guess = _sense(log)
    degrees = sense * _step(log, numbers) * numbers
    setup = Setup(degrees, (width, height), offset=(0.0, (middle - line) * height))
    return setup if parallel else replace(setup, source_object=near, source_detector=far), said + guess


def _camera_distance(log: IniText, near: float) -> float:
    """From the source, as told, else as the pixel of the camera and that in the object have it."""
    camera = 1e-3 * _camera_pixel(log)
    in_object = 1e-3 * log.number("Image Pixel Size (um)", otherwise=0.0)
    computed = near * camera / in_object if camera > in_object > 0 else None
    return log.number("Camera to Source (mm)", otherwise=computed)


def _step(log: IniText, numbers: np.ndarray) -> float:
    """Degrees from one picture to the next."""
    step = log.number("Rotation Step (deg)", otherwise=0.0)
    if step == 0 and log.text("Use 360 Rotation").upper() == "YES":
        return 360.0 / (int(numbers[-1]) + 1)
    return step or require_number("Rotation Step (deg)", step, above=0.0)


def _pixel(log: IniText, magnification: float) -> tuple[float, list[str]]:
    """The side of a pixel in the object, in mm, beside that of the camera."""
    told = log.number("Image Pixel Size (um)", "Scaled Image Pixel Size (um)", otherwise=0.0)
    camera, said = _camera_pixel(log), []
    scaled = log.number("Scaled Image Pixel Size (um)", otherwise=told)
    if told and abs(scaled - told) > _ROUND * told:
        said.append(f"the pictures were scaled: their pixel is taken to be {scaled:g} um, not {told:g}")
        told = scaled
    if not told > 0:
        if not camera > 0:
            raise fail("path", "a number as 'Image Pixel Size (um)' in the log", "none", "give pixel=")
        said.append("no Image Pixel Size: it is taken to be the camera's, brought down to the axis")
        return 1e-3 * camera / magnification, said
    return 1e-3 * told, said


def _camera_pixel(log: IniText) -> float:
    """In um, binned; 0 where it is not told."""
    binning = re.match(r"\d+", log.text("Camera binning"))
    return log.number("Camera Pixel Size (um)", otherwise=0.0) * (int(binning[0]) if binning else 1)


def _postalignment(log: IniText, folder: Path) -> tuple[float, list[str]]:
    """The axis' shift in columns: the log's, else what a log of the same scan beside it tells."""
    part = int(log.number("Current scan number", otherwise=1))
    parts = int(log.number("Number of connected scans", otherwise=1))
    keys = [f"Sub-scan post alignment [{part - 1}]"] if parts > 1 else ["Postalignment", "Post alignment"]
    said = [f"this is part {part} of {parts} connected scans, and read alone"] if parts > 1 else []
    whole = log.text("Filename Prefix").split("~")[0]
    beside = (text for text in map(IniText, _all_logs(folder)) if _of_scan(text, whole))
    found = (text.number(*keys, otherwise=0.0) for text in (log, *beside))
    shift = next((shift for shift in found if shift), log.number("Postalignment", otherwise=0.0))
    if shift == 0:
        axis = "no Postalignment in the log: the axis is taken to fall on the detector's middle; give offset= else"
        said.append(Guess(axis, "offset"))
    return shift, said


def _of_scan(text: IniText, whole: str) -> bool:
    return bool(whole) and text.text("Filename Prefix").split("~")[0] == whole


def _drift(log: IniText) -> list[str]:
    """What NRecon takes from the TIFFs' headers or from a table beside them."""
    most = [log.text(f"Maximum {side} TS") for side in ("vertical", "horizontal")]
    table = log.text("TS modified according to").replace("\\", "/").split("/")[-1]
    if not table:
        return []
    far = f"at most {most[0] or '?'} rows and {most[1] or '?'} columns"
    return [
        f"the pictures have moved, by {far} ({table}), which is not undone; reconstruct with align=True (--align), "
        "which finds it"
    ]


def _sense(log: IniText) -> tuple[int, list[str]]:
    """-1 for an object that turns counterclockwise seen from above, about which the source goes clockwise."""
    text = log.text("Rotation Direction", "Gantry direction").upper()
    if text in ("CC", "CCW"):
        return -1, []
    if text == "CW":
        return 1, []
    return -1, [
        "no direction of rotation: it is taken to be CC; if 'check' says that views are turned, give arc="
    ]


def _filters(log: IniText) -> dict[str, float] | None:
    return filters_of(log.text("Filter")) if "Filter" in log else None


def _with_open_beam(told: Acquisition, folder: Path, log: IniText, taken: set[Path]) -> Acquisition:
    """Pictures that the scanner has corrected have one value for the open beam; else there may be flats."""
    corrected = "ON" in log.text("Flat Field Correction").upper()
    if corrected:
        # Air may well reach the largest number that fits.
        reference = log.number("Reference Intensity", otherwise=0.0)
        return replace(told, white=reference or None, saturates=False)
    left = [file for file in tiffs_in(folder) if file not in taken]
    for name in ("flats", "darks"):
        files = [file for file in left if has_word(file.stem, name)]
        if files:
            told = replace(told, **{name: TiffFrames(files)})  # type: ignore[arg-type]
    return told
