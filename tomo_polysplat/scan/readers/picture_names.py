"""Which pictures of a folder are which, by their names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.scan.readers.entries import entries_of

__all__ = [
    "PICTURE_SUFFIXES",
    "gaps_in",
    "has_word",
    "in_order",
    "is_reconstructed",
    "named_files",
    "numbers_of",
    "pictures_in",
    "tiffs_in",
]

TIFF_SUFFIXES = (".tif", ".tiff")
# What a plain stack may be of.
PICTURE_SUFFIXES = (*TIFF_SUFFIXES, ".npy", ".edf")
_MOST_GAPS = 3
# Words in a name that make a picture, or a folder of them, a flat or a dark one, or one with the object.
_WORDS = {
    "flats": (
        *(
            "flat",
            "flats",
            "flatfield",
            "white",
            "whites",
            "whitefield",
            "open",
            "openbeam",
            "bright",
            "brightfield",
        ),
        *("ref", "refs", "reference", "gain", "ff", "i0", "io", "blank", "blanks"),
    ),
    "darks": ("dark", "darks", "darkfield", "darkcurrent", "dk", "df", "di", "background"),
    "projections": ("projections", "projection", "proj", "projs", "data", "tomo", "images", "raw"),
}


# Folders that hold reconstructions.
_RECONSTRUCTED = re.compile(r"rec\w*|slices|volume", re.I)


def is_reconstructed(folder: Path) -> bool:
    """Whether a folder's name tells of slices, not of projections."""
    return _RECONSTRUCTED.fullmatch(folder.name) is not None


def in_order(files: Iterable[Path]) -> list[Path]:
    """By name, and by number where names differ in one: picture 10 comes after picture 9."""
    return sorted(files, key=lambda file: [_part(text) for text in re.split(r"(\d+)", file.name.lower())])


def _part(text: str) -> tuple[int, str]:
    return (int(text), "") if text.isdecimal() else (-1, text)


def numbers_of(files: Sequence[Path]) -> np.ndarray | None:
    """Numbers at the end of names that differ in nothing else, from 0 on; None where they do not ascend."""
    ends = [re.fullmatch(r"(.*?)(\d{1,15})", file.stem, re.S) for file in files]
    if not files or None in ends or len({end[1].lower() for end in ends if end}) > 1:
        return None
    numbers = np.array([int(end[2]) for end in ends if end])
    return numbers - numbers[0] if (np.diff(numbers) > 0).all() else None


def gaps_in(files: Sequence[Path]) -> str:
    """Where the numbers of pictures jump, such as ``7 to 9``; nothing where they do not."""
    numbers = numbers_of(files)
    if numbers is None or len(numbers) < 2:
        return ""
    steps = np.diff(numbers)
    jumps = np.flatnonzero(steps != np.median(steps))[:_MOST_GAPS]
    return ", ".join(f"{_end(files[k])} to {_end(files[k + 1])}" for k in jumps)


def _end(file: Path) -> str:
    return re.split(r"\D", file.stem)[-1].lstrip("0") or "0"


def tiffs_in(folder: Path) -> list[Path]:
    """The TIFF files of a folder, in order."""
    return _of_kind(folder, TIFF_SUFFIXES)


def pictures_in(folder: Path) -> list[Path]:
    """The TIFF files of a folder, else its EDF, else its ``.npy`` files, in order."""
    kinds = (TIFF_SUFFIXES, (".edf",), (".npy",))
    return next((files for kind in kinds if (files := _of_kind(folder, kind))), [])


def _of_kind(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    return in_order(file for file in entries_of(folder) if file.suffix.lower() in suffixes and file.is_file())


def has_word(name: str, kind: str) -> bool:
    """Whether a word of a name tells of flats, darks or projections."""
    words = re.split(r"[^a-z0-9]+|(?<=[a-z])(?=[0-9])", name.lower())
    return bool(set(words) & set(_WORDS[kind]))


def named_files(folder: Path, names: Any, argument: str) -> list[Path]:
    """Files of a folder, a file or a pattern, or of several, as seen from the scan's folder, else from where we are."""
    files: list[Path] = []
    for text in [names] if isinstance(names, (str, Path)) else list(names):
        here = next((place for place in (folder / text, Path(text)) if place.exists()), None)
        if here is not None:
            files += pictures_in(here) if here.is_dir() else [here]
        elif not Path(text).is_absolute():
            files += in_order(file for file in folder.glob(str(text)) if not file.name.startswith("."))
    if not files:
        raise fail(argument, "files of pictures", f"{names}, of which there is none in {folder}")
    return files
