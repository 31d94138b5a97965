"""Zeiss Xradia: a .txrm file with the pictures, their open beam, angles and distances, or one .xrm file a view.

Rows are taken to begin at the bottom, pictures to be as seen from the source, and the object to turn counterclockwise
with the angles, as the reader of the Core Imaging Library takes them. By how much a picture is moved by the drift of
the sample or on purpose (``Alignment/X-Shifts``) is undone in the geometry, without resampling.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.physics.filter_text import filters_of
from tomo_polysplat.scan.readers.acquisition import Acquisition, Guess, Setup, Tube
from tomo_polysplat.scan.readers.compound import CompoundFile, is_compound
from tomo_polysplat.scan.readers.entries import entries_of
from tomo_polysplat.scan.readers.files_of_scans import the_one
from tomo_polysplat.scan.readers.stated import require_known, stated_over
from tomo_polysplat.scan.readers.xradia_frames import (
    XrmFrames,
    picture_names,
    reference_names,
    reference_seconds,
)
from tomo_polysplat.scan.readers.xradia_series import SeriesFrames, XrmSeries, sorted_out
from tomo_polysplat.units import CM_PER_UNIT

if TYPE_CHECKING:
    from tomo_polysplat.scan.readers.frames import Frames

__all__ = ["KIND", "read", "recognises"]

KIND = "Zeiss Xradia (.txrm, .xrm)"
# The first kind that is there is the scan; the others beside it are single pictures and reconstructions.
_SUFFIXES = (".txrm", ".xrm", ".txm")
# Columns by which two statements of the axis may differ.
_CENTRES = 0.1
_ZONE_PLATES = "ConfigZonePlates"
# Relative changes of exposure or distance that count.
_SAME = 1e-3
_CONE = 1
_TEXTS = (
    "ImageInfo/Date",
    "ImageInfo/ObjectiveName",
    "ImageInfo/SystemType",
    "AcquisitionSettings/AcqModeString",
)
_NUMBERS = {
    "ImageInfo/Current": "<f4",
    "ImageInfo/OpticalMagnification": "<f4",
    "ImageInfo/CamPixelSize": "<f4",
    "ImageInfo/CameraBinning": "<i4",
    "ImageInfo/CameraNumberOfFramesPerImage": "<i4",
    "ImageInfo/ConeAngle": "<f4",
    "ImageInfo/CameraOffset": "<f4",
    "ReconSettings/RotationAngle": "<f4",
    "ReconSettings/BeamHardening": "<f4",
}


def recognises(path: Path) -> bool:
    """Whether it is such a file or a folder with one."""
    return bool(_files(path))


def read(path: Path, stated: Mapping[str, Any]) -> Acquisition:
    """See `tomo_polysplat.load_scan`; `stated` has its ``scanner``."""
    known, files = require_known(stated, "scanner"), _files(path)
    if len(files) > 1 and files[0].suffix.lower() == ".xrm":
        return _of_single_views(files, known)
    chosen = the_one(files)
    if chosen.suffix.lower() == ".txm":
        raise fail("path", "a scan", f"{chosen}, a reconstruction", "name the .txrm file of the projections")
    file = CompoundFile(chosen)
    names = picture_names(file)
    light, exposure, said = _exposures(file, len(names), reference_seconds(file))
    frames = XrmFrames(file, names, "ImageInfo/DataType", light)
    planned = int(file.number("ImageInfo/NoOfImages", "<u4") or 0)
    if len(names) < planned:
        said.append(f"{len(names)} pictures are there, the file tells of {planned}")
    open_beam, kind = reference_names(file)
    flats = XrmFrames(file, open_beam, kind) if open_beam else None
    told = _told(file, frames, flats, name=chosen.stem, exposure=exposure, saturates=light is None)
    return stated_over(told.saying(*said), known, chosen.parent)


def _of_single_views(files: Sequence[Path], known: Mapping[str, Any]) -> Acquisition:
    """One file a view, those of the open beam among them by their names."""
    views, open_beam = sorted_out(files)
    if not views:
        got = f"pictures of the open beam alone in {files[0].parent}"
        raise fail("path", "pictures of an object", got, "name the one that is the scan")
    series = XrmSeries(views)
    beside = XrmSeries(open_beam).number("ImageInfo/ExpTimes") if open_beam else None
    light, exposure, said = _exposures(series, len(views), beside)
    flats: Frames | None = SeriesFrames(open_beam) if open_beam else None
    if flats is None and (inside := reference_names(first := CompoundFile(views[0])))[0]:
        flats = XrmFrames(first, *inside)
    frames, folder = SeriesFrames(views, light), files[0].parent
    told = _told(series, frames, flats, name=folder.name, exposure=exposure, saturates=light is None)
    return stated_over(told.saying(*said), known, folder)


def _told(file: CompoundFile | XrmSeries, frames: Frames, flats: Frames | None, **known: Any) -> Acquisition:
    """All that the file, or the files of single views, tell."""
    setup, shifts, said = _setup(file, frames.shape[0])
    if flats is not None:
        dark = "no dark pictures: without light a pixel is taken to count 0; give darks= if it does not"
        said.append(Guess(dark, "darks"))
    parts: dict[str, Any] = {"flats": flats, "tube": _tube(file), "shifts": shifts, "other": _others(file)}
    return Acquisition(KIND, frames, setup, top_first=False, **parts, **known).saying(*said)


def _files(path: Path) -> list[Path]:
    if path.is_file():
        return [path] if path.suffix.lower() in _SUFFIXES and is_compound(path) else []
    inside = [file for file in entries_of(path) if file.is_file()]
    kinds = ([file for file in inside if file.suffix.lower() == suffix] for suffix in _SUFFIXES)
    return next((files for some in kinds if (files := [file for file in some if is_compound(file)])), [])


def _exposures(
    file: CompoundFile | XrmSeries, views: int, open_beam: float | None
) -> tuple[np.ndarray | None, float | None, list[str]]:
    """What makes each picture's light that of the open beam, None where it is; seconds a picture; what to say."""
    seconds = file.numbers("ImageInfo/ExpTimes")[:views].astype(np.float64)
    if not len(seconds) and (once := file.number("ImageInfo/ExpTime")):
        seconds = np.full(views, once)
    if not 0 < views <= len(seconds) or not (np.isfinite(seconds).all() and (seconds > 0).all()):
        return None, None, []
    usual = float(np.median(seconds))
    beside = open_beam or usual
    light = beside / seconds
    if np.abs(light - 1).max() < _SAME:
        return None, usual, []
    ends = dict.fromkeys(f"{end:.4g}" for end in (seconds.min(), seconds.max()))
    words = f"pictures of {' to '.join(ends)} s are compared with an open beam of {beside:.4g} s"
    return light, usual, [words]


def _setup(file: CompoundFile | XrmSeries, views: int) -> tuple[Setup, np.ndarray | None, list[str]]:
    degrees, said = _per_view(file, "ImageInfo/Angles", views), []
    pixel = 1e-3 * (file.number("ImageInfo/PixelSize") or 0.0)
    if not pixel > 0:
        raise fail("path", "the size of a pixel as ImageInfo/PixelSize", f"none in {file.path}")
    unit = _distance_unit(file)
    near, far = (unit * np.abs(file.numbers(f"ImageInfo/{end}toRADistance")[:views]) for end in "SD")
    given = len(near) > 0 and len(far) > 0 and min(near[0], far[0]) > 0
    if given and max(np.ptp(near) / near[0], np.ptp(far) / far[0]) > _SAME:
        said.append("the distances change from view to view: those of the first are taken for all")
    beam = file.number("ImageInfo/XrayGeometry", "<i4")
    # A zone plate makes parallel what it passes.
    cone = given and _ZONE_PLATES not in file if beam is None else beam == _CONE
    if cone and not given:
        raise fail("path", "distances as ImageInfo/StoRADistance and DtoRADistance", f"none in {file.path}")
    magnified = (near[0] + far[0]) / near[0] if cone else 1.0
    # The file's pixel is that in the object.
    setup = Setup(-degrees, float(pixel * magnified))
    if cone:
        setup = replace(setup, source_object=float(near[0]), source_detector=float(near[0] + far[0]))
    centres = [file.number(f"{name}/CenterShift") for name in ("ReconSettings", "AutoRecon")]
    centre = next((centre for centre in centres if centre), 0.0)
    if all(centres) and abs(centres[0] - centres[1]) > _CENTRES:  # type: ignore[operator]
        said.append(
            f"the axis is {centre:g} columns off, as ReconSettings tells; AutoRecon tells {centres[1]:g}"
        )
    if not centre:
        axis = "the axis is taken to fall on the detector's middle; give offset= if it does not"
        said.append(Guess(axis, "offset"))
    setup = replace(setup, offset=(centre * setup.pixel, 0.0))  # type: ignore[operator]
    return setup, _shifts(file, views), said


def _distance_unit(file: CompoundFile | XrmSeries) -> float:
    """Millimetres in the unit of the source's axis, which is that of the distances."""
    names, units = (file.texts(f"PositionInfo/Axis{kind}") for kind in ("Names", "Units"))
    named = dict(zip(names, units))
    return 10 * CM_PER_UNIT.get(named.get("Source Z", "mm").replace("\u00b5", "u"), 0.1)


def _shifts(file: CompoundFile | XrmSeries, views: int) -> np.ndarray | None:
    """Columns and rows by which pictures are to be moved, (views, 2); None where they are not."""
    sides = [file.numbers(f"Alignment/{axis}-Shifts")[:views] for axis in "XY"]
    moved = [side if len(side) == views else np.zeros(views) for side in sides]
    shifts = np.stack(moved, axis=1).astype(np.float64)
    if not np.isfinite(shifts).all():
        raise fail("Alignment/X-Shifts, Y-Shifts", "finite numbers", f"others in {file.path}")
    return shifts if shifts.any() else None


def _per_view(file: CompoundFile | XrmSeries, name: str, views: int) -> np.ndarray:
    found = file.numbers(name)[:views].astype(np.float64)
    if len(found) < views or not np.isfinite(found).all():
        got = f"{np.isfinite(found).sum()} in {file.path}"
        raise fail(name, f"one finite number for each of {views} pictures", got)
    return found


def _tube(file: CompoundFile | XrmSeries) -> Tube:
    kvp = file.number("ImageInfo/Voltage") or file.number("ImageInfo/XrayVoltage")
    name = _filter(file)
    # The makes of Zeiss' own filters (LE1 to HE18) are not published.
    return Tube(kvp if kvp and kvp > 0 else None, filters_of(name) if name else None)


def _filter(file: CompoundFile | XrmSeries) -> str:
    return file.text("AcquisitionSettings/SourceFilterName") or file.text("ImageInfo/SourceFilterName")


def _others(file: CompoundFile | XrmSeries) -> dict[str, str]:
    """What somebody may want to see again."""
    texts = {name: file.text(name) for name in _TEXTS}
    texts["SourceFilterName"] = _filter(file)
    for name, dtype in _NUMBERS.items():
        value = file.number(name, dtype)
        texts[name] = "" if value is None else f"{value:g}"
    return {name.split("/")[-1]: text for name, text in texts.items() if text}
