"""Bruker SkyScan: a .log file, and TIFFs that are named after it.

What the keys mean is as NRecon, the maker's program, uses them: lengths in the object are those of ``Image Pixel
Size`` at ``Object to Source``, binning included; lines are counted from the lowest; ``Postalignment`` is the axis'
shift in columns. Its sign and the sense of rotation are those of the SkyScan parser of the ASTRA Toolbox's tools:
pictures are as seen from the detector, and the object turns counterclockwise seen from above for ``CC``.
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
from tomo_polysplat.scan.readers.acquisition import Acquisition, Setup, Tube
from tomo_polysplat.scan.readers.files_of_scans import the_one
from tomo_polysplat.scan.readers.frames import TiffFrames
from tomo_polysplat.scan.readers.ini_text import IniText
from tomo_polysplat.scan.readers.picture_names import has_word, in_order, tiffs_in
from tomo_polysplat.scan.readers.stated import require_known, stated_over

__all__ = ["KIND", "read", "recognises"]

KIND = "Bruker SkyScan (.log)"
_START_BYTES = 4096
_ROUND = 0.005
_MOST_DIGITS = 20


def recognises(path: Path) -> bool:
    """Whether it is a SkyScan's .log file or a folder with one."""
    return bool(_logs(path))


def read(path: Path, stated: Mapping[str, Any]) -> Acquisition:
    """See `tomo_polysplat.load_scan`; `stated` has its ``scanner``."""
    file = the_one(_logs(path), remedy="name its .log file")
    folder, log = file.parent, IniText(file)
    files = _pictures(folder, log, file.stem)
    expected = int(log.number("Number of Files", otherwise=len(files)))
    said = []
    if len(files) != expected:
        said.append(
            f"{len(files)} pictures are there, the log tells of {expected}: they are taken from the first on"
        )
    frames = TiffFrames(files[:expected])
    _require_size(log, frames)
    setup, more = _setup(log, frames.shape)
    told = Acquisition(
        KIND,
        frames,
        setup,
        name=log.text("Filename Prefix", otherwise=file.stem).rstrip("_~ "),
        from_detector=True,
        tube=Tube(log.number("Source Voltage (kV)"), _filters(log)),
        exposure=log.number("Exposure (ms)", otherwise=0.0) / 1000 or None,
    )
    told = _with_open_beam(told, folder, log, set(files)).saying(*said, *more)
    told = stated_over(told, require_known(stated, "scanner"), folder)
    return replace(told, other=log.others())


def _logs(path: Path) -> list[Path]:
    files = [path] if path.is_file() else [file for file in path.iterdir() if file.is_file()]
    return sorted(file for file in files if file.suffix.lower() == ".log" and _is_skyscan(file))


def _is_skyscan(file: Path) -> bool:
    with open(file, "rb") as stream:
        start = stream.read(_START_BYTES).lower()
    # Logs of a reconstruction, which lie beside its slices, go on with that section and have the same keys.
    return b"[acquisition]" in start and b"object to source" in start


def _pictures(folder: Path, log: IniText, stem: str) -> list[Path]:
    """The numbered pictures: those of the log's prefix, or of the log's own name where the folder was renamed."""
    tiffs = tiffs_in(folder)
    length = log.number("Filename Index Length", otherwise=4)
    digits = int(require_number("Filename Index Length", length, at_least=0, at_most=_MOST_DIGITS))
    for prefix in (log.text("Filename Prefix"), stem, ""):
        name = re.compile(rf"{re.escape(prefix)}_*\d{{{digits}}}" if prefix else rf".*\d{{{digits}}}", re.I)
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


def _setup(log: IniText, shape: tuple[int, int, int]) -> tuple[Setup, list[str]]:
    views, rows, _ = shape
    said = []
    near, far = log.number("Object to Source (mm)"), log.number("Camera to Source (mm)")
    # Brought to the detector, where it is the camera's as far as the distances are exact.
    width = 1e-3 * log.number("Image Pixel Size (um)") * far / near
    ratio = log.number("CameraXYRatio", "Camera X/Y Ratio", otherwise=1.0)
    if abs(ratio - 1) > _ROUND:
        said.append(
            f"pixels are taken to be {ratio:g} times as wide as high (CameraXYRatio); give pixel= otherwise"
        )
    height = width / (ratio if ratio > 0 else 1.0)
    shift = log.number("Postalignment", "Post alignment", otherwise=0.0)
    if shift == 0:
        said.append(
            "no Postalignment in the log: the axis is taken to fall on the detector's middle; give offset= else"
        )
    line = log.number("Optical Axis (line)", otherwise=(rows - 1) / 2)
    tilt = log.number("Image Rotation", otherwise=0.0)
    if tilt:
        said.append(
            f"the camera's rotation of {tilt:g} degrees is not undone; give roll={tilt:g} or roll={-tilt:g}"
        )
    if "ON" in log.text("Camera Offset").upper():
        said.append("the camera was offset: is that in the pictures? give offset= if it is not")
    sense, guess = _sense(log)
    # Counted from the other side, as the pictures are.
    offset = (-shift * width, ((rows - 1) / 2 - line) * height)
    degrees = sense * log.number("Rotation Step (deg)") * np.arange(views)
    return Setup(degrees, (width, height), near, far, offset), said + guess


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
