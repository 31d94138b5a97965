"""A plain stack of pictures in an ``.npz`` archive of NumPy's, flats, darks and angles beside them.

A TOML file beside it, or arguments, tell the distances, as for any plain stack.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.scan.archive import archive_names, read_archive
from tomo_polysplat.scan.readers.acquisition import Acquisition
from tomo_polysplat.scan.readers.entries import entries_of
from tomo_polysplat.scan.readers.files_of_scans import the_one
from tomo_polysplat.scan.readers.frames import ArrayFrames
from tomo_polysplat.scan.readers.picture_names import pictures_in
from tomo_polysplat.scan.readers.picture_stack import full_turn, guessed, stated_beside, written_beside
from tomo_polysplat.scan.readers.stated import stated_over

__all__ = ["KIND", "read", "recognises"]

KIND = "stack in an .npz file"
_NAMES = {
    "projections": ("projections", "proj", "data"),
    "flats": ("flats", "flat", "white", "whites"),
    "darks": ("darks", "dark"),
    "degrees": ("degrees", "angles", "theta"),
}
# What the package's own archives have.
_OWN = {"vectors", "vol_shape", "vol_window"}


def recognises(path: Path) -> bool:
    """Whether it is such a file, or a folder with one and no other pictures."""
    return bool(_files(path))


def read(path: Path, stated: Mapping[str, Any]) -> Acquisition:
    """See `tomo_polysplat.load_scan`; `stated` has its ``scanner``."""
    file = the_one(_files(path))
    beside = file.with_suffix(".toml")
    written, other = written_beside(beside if beside.is_file() else file.parent)
    known = stated_beside(written, stated)
    arrays = _arrays(file)
    if "degrees" in arrays and not {"degrees", "arc"} & known.keys():
        known["degrees"] = _degrees(arrays["degrees"])
    frames = ArrayFrames(arrays["projections"])
    told = Acquisition(KIND, frames, full_turn(frames.shape[0]), file.stem, other=other)
    for name in {"flats", "darks"} & arrays.keys():
        told = replace(told, **{name: ArrayFrames(_stack(arrays[name]))})  # type: ignore[arg-type]
    return guessed(stated_over(told, known, file.parent), known)


def _files(path: Path) -> list[Path]:
    if path.is_file():
        return [path] if path.suffix.lower() == ".npz" and _is_stack(path) else []
    inside = [file for file in entries_of(path) if file.suffix.lower() == ".npz" and file.is_file()]
    return [file for file in inside if _is_stack(file)] if inside and not pictures_in(path) else []


def _is_stack(file: Path) -> bool:
    names = archive_names(file)
    return bool(names & set(_NAMES["projections"])) and not names & _OWN


def _arrays(file: Path) -> dict[str, np.ndarray]:
    """The arrays by our names; where there are several for one thing, the first that `_NAMES` has."""
    there = archive_names(file)
    chosen = {ours: next((name for name in names if name in there), None) for ours, names in _NAMES.items()}
    found = read_archive(file, [name for name in chosen.values() if name is not None])
    return {ours: found[name] for ours, name in chosen.items() if name is not None}


def _stack(array: np.ndarray) -> np.ndarray:
    return array[None] if array.ndim == 2 else array


def _degrees(angles: np.ndarray) -> np.ndarray:
    """Refuse angles that are radians in all likelihood."""
    if angles.dtype.kind == "f" and angles.size > 2 and 1 < np.ptp(angles) < 2.1 * np.pi:
        got = f"{angles.min():.3g} to {angles.max():.3g}, which look like radians"
        raise fail("degrees", "angles in degrees", got, "pass scanner={'degrees': ...}")
    return angles
