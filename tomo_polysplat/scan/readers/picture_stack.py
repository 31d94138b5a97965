"""A plain stack of pictures (TIFF, EDF or ``.npy``), flats and darks beside them; somebody has to say the distances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.scan.readers.acquisition import Acquisition, Setup
from tomo_polysplat.scan.readers.entries import entries_of
from tomo_polysplat.scan.readers.other_makers import what_is_told
from tomo_polysplat.scan.readers.picture_files import frames_of
from tomo_polysplat.scan.readers.picture_names import (
    PICTURE_SUFFIXES,
    gaps_in,
    has_word,
    is_reconstructed,
    named_files,
    of_one_name,
    pictures_in,
)
from tomo_polysplat.scan.readers.stated import read_toml, require_known, require_no_slips, stated_over

__all__ = ["full_turn", "guessed", "read", "recognises", "stated_beside", "toml_files", "written_beside"]

KIND = "stack of TIFFs, EDF or .npy files"
_MOST_NAMED = 3
_REMEDY = (
    "pass scanner={'source_object': ..., 'source_detector': ..., 'pixel': ...} in mm (--sod, --sdd, --pixel), write "
    "them into a file scan.toml in the folder, or say that beam = 'parallel'"
)


def recognises(path: Path) -> bool:
    """Whether it is a picture, a TOML file, or a folder with pictures in it or in folders of it."""
    if path.is_file():
        return path.suffix.lower() in (*PICTURE_SUFFIXES, ".toml")
    return bool(pictures_in(path)) or any(
        pictures_in(folder) for folder in entries_of(path) if folder.is_dir()
    )


def read(path: Path, stated: Mapping[str, Any]) -> Acquisition:
    """See `tomo_polysplat.load_scan`; `stated` has its ``scanner``."""
    folder = path if path.is_dir() else path.parent
    written, other = written_beside(path)
    known = stated_beside(written, stated)
    if path.suffix.lower() in PICTURE_SUFFIXES and path.is_file():
        known.setdefault("projections", path)
    _require_lengths(folder, known)
    files, passed_over = _sorted_out(folder, known)
    frames = frames_of(files["projections"])
    known |= {name: files[name] for name in ("flats", "darks") if files[name]}
    told = Acquisition(KIND, frames, full_turn(frames.shape[0]), folder.name, other=other)
    if passed_over:
        names = ", ".join(file.name for file in passed_over[:_MOST_NAMED])
        names += f" and {len(passed_over) - _MOST_NAMED} more" if len(passed_over) > _MOST_NAMED else ""
        told = told.saying(
            f"pictures of other names are passed over: {names}; give projections= if they are views"
        )
    if "degrees" not in known and (gaps := gaps_in(files["projections"])):
        told = told.saying(
            f"the numbers of the pictures jump ({gaps}): steps are taken to be even over those that are there; give "
            "degrees="
        )
    return guessed(stated_over(told, known, folder), known)


def _require_lengths(folder: Path, known: Mapping[str, Any]) -> None:
    """Refuse pictures beside the text of a scanner that is not read, until somebody says what it tells."""
    if "pixel" in known or known.get("beam") == "parallel":
        return
    told = what_is_told(folder)
    if told is not None:
        raise fail(
            "path",
            "the distances and the pixel of the scanner",
            f"{told[0]}, which is not read",
            f"pass {told[1]} (or the same in scan.toml), then 'tomo-polysplat check' tells the sense of rotation",
        )


def full_turn(views: int) -> Setup:
    """What is taken where nothing is told: even steps, and a pixel that has yet to be known."""
    return Setup(np.arange(views) * (360.0 / views), np.nan)


def toml_files(folder: Path) -> list[Path]:
    """Those beside the pictures."""
    return [file for file in entries_of(folder) if file.suffix.lower() == ".toml"]


def written_beside(path: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """Known and other keys of the TOML file that is meant, or the only one in the folder."""
    beside = toml_files(path) if path.is_dir() else []
    if len(beside) > 1:
        raise fail("path", "one TOML file in the folder", ", ".join(file.name for file in beside), "name one")
    file = beside[0] if beside else path
    if file.suffix.lower() != ".toml":
        return {}, {}
    table = read_toml(file)
    aliased = {key: value for key, value in table.items() if _is_known(key)}
    other = {key: str(value) for key, value in table.items() if not _is_known(key)}
    require_no_slips(other, file.name)
    return require_known(aliased, file.name), other


def stated_beside(written: Mapping[str, Any], stated: Mapping[str, Any]) -> dict[str, Any]:
    """What is written in a file, with what the user states in its place: angles as a list, or as an arc."""
    said = require_known(stated, "scanner")
    angles = {"degrees", "arc"}
    kept = {key: value for key, value in written.items() if not (key in angles and said.keys() & angles)}
    return kept | said


def _is_known(key: str) -> bool:
    try:
        require_known({key: ""}, "")
    except ValueError:
        return False
    return True


def _sorted_out(folder: Path, known: Mapping[str, Any]) -> tuple[dict[str, list[Path]], list[Path]]:
    """Files of the projections, flats and darks, and those that are none: as stated, else by their names."""
    kinds = ("projections", "flats", "darks")
    files = {name: named_files(folder, known[name], name) for name in kinds if name in known}
    taken = {file for some in files.values() for file in some}
    inside = [inner for inner in entries_of(folder) if inner.is_dir()]
    pictures, passed_over = pictures_in(folder), list[Path]()
    for name in ("flats", "darks"):
        if name not in files:
            matching = [file for file in pictures if has_word(file.stem, name) and file not in taken]
            if len(matching) == len(pictures) and not any(map(pictures_in, inside)):
                # A word that all pictures of a scan have tells of the sample.
                matching = []
            for inner in inside:
                matching += pictures_in(inner) if has_word(inner.name, name) else []
            files[name] = matching
            taken |= set(matching)
    if "projections" not in files:
        left = [file for file in pictures if file not in taken]
        # Flats that were not named, where one of them was, are none of the object.
        left = [file for file in left if not any(has_word(file.stem, name) for name in kinds[1:])] or left
        left, passed_over = of_one_name(left or _pictures_of_one(inside, taken))
        if not left:
            remedy = "pass scanner={'projections': 'FOLDER or PATTERN'} (--projections)"
            raise fail("path", "pictures of an object (TIFF, EDF or .npy)", f"none in {folder}", remedy)
        files["projections"] = left
    return files, passed_over


def _pictures_of_one(folders: list[Path], taken: set[Path]) -> list[Path]:
    """Pictures of the only folder named as those of projections are, else of the only one with pictures at all."""
    named = [folder for folder in folders if has_word(folder.name, "projections")]
    full = [
        folder
        for folder in folders
        if not is_reconstructed(folder) and (pictures := pictures_in(folder)) and pictures[0] not in taken
    ]
    only = next((some[0] for some in (named, full) if len(some) == 1), None)
    return [] if only is None else pictures_in(only)


def guessed(told: Acquisition, known: Mapping[str, Any]) -> Acquisition:
    """Refuse what cannot be guessed, and say what is."""
    setup = told.setup
    assert isinstance(setup, Setup)
    parallel = known.get("beam") == "parallel"
    if "pixel" not in known:
        if not parallel:
            raise fail("path", "the distances and the pixel of the scanner", f"{told.kind} alone", _REMEDY)
        told = replace(told, unit="pixel", setup=replace(setup, pixel=1.0))
        told = told.saying("the pixel is not known: lengths are in pixels; give pixel=")
    elif not parallel and (setup.source_object is None or setup.source_detector is None):
        raise fail("source_object, source_detector", "both distances of a cone beam", "not both", _REMEDY)
    if not {"degrees", "arc"} & known.keys():
        views = told.frames.shape[0]
        told = told.saying(f"no angles: {views} views are taken to make one full turn; give arc= or degrees=")
    if told.input == "counts" and told.flats is not None and told.darks is None:
        told = told.saying("no dark pictures: without light a pixel is taken to count 0; give darks=")
    if "offset" not in known:
        told = told.saying("the axis is taken to fall on the detector's middle; give offset= if it does not")
    return told
