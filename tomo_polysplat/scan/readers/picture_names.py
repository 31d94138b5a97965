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
    "of_one_name",
    "pictures_in",
    "tiffs_in",
]

TIFF_SUFFIXES = (".tif", ".tiff")
# What a plain stack may be of.
PICTURE_SUFFIXES = (*TIFF_SUFFIXES, ".npy", ".edf")
_MOST_GAPS, _MOST_NAMES = 3, 4
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
    "darks": (
        *("dark", "darks", "darkfield", "darkcurrent", "darkend", "dk", "df", "di", "background"),
        *("offset", "offsets"),
    ),
    "projections": ("projections", "projection", "proj", "projs", "data", "tomo", "images", "raw"),
}


# A number in a name, or an angle, as in -2.5 and 2p5.
_NUMBER = re.compile(r"-?\d+([.,p]\d+)*")
# Folders that hold reconstructions; NRecon makes one of the scan's name and "_Rec".
_RECONSTRUCTED = re.compile(r"rec\w*|.*_rec|slices|volume", re.I)
# Where a name that is no word of small letters begins a new word.
_ENDS_OF_WORDS = re.compile(r"[^A-Za-z0-9]+|(?<=[a-z])(?=[A-Z0-9])")


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
    """The TIFF, EDF or ``.npy`` files of a folder, in order: of those that take the most room, as a scan does."""
    kinds = (TIFF_SUFFIXES, (".edf",), (".npy",))
    found = [files for kind in kinds if (files := _of_kind(folder, kind))]
    return found[0] if len(found) == 1 else max(found, key=_room, default=[])


def _room(files: Sequence[Path]) -> int:
    return sum(file.stat().st_size for file in files)


def of_one_name(files: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Pictures of one name and different numbers, which most of them have to be, and the others.

    Where each has a name of its own, names tell nothing.

    Raises
    ------
    ValueError
        If no name is that of more than half of them.
    """
    named: dict[str, list[Path]] = {}
    for file in files:
        named.setdefault(_NUMBER.sub("#", file.stem.lower()), []).append(file)
    most = max(named.values(), key=len, default=[])
    if len(named) < 2 or len(most) < 2:
        return list(files), []
    if 2 * len(most) <= len(files):
        got = ", ".join(f"{len(some)} as {some[0].name}" for some in list(named.values())[:_MOST_NAMES])
        remedy = "name those of the scan by a pattern such as proj_*.tif: projections (--projections)"
        raise fail("path", "pictures of one name and different numbers", got, remedy)
    kept = set(most)
    return most, [file for file in files if file not in kept]


def _of_kind(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    return in_order(file for file in entries_of(folder) if file.suffix.lower() in suffixes and file.is_file())


def has_word(name: str, kind: str) -> bool:
    """Whether a word of a name tells of flats, darks or projections."""
    # With its number as well, as in i0, and as in whatever is written in capitals.
    words = {
        *_ENDS_OF_WORDS.split(name),
        *_ENDS_OF_WORDS.split(name.lower()),
        *re.split(r"[^A-Za-z0-9]+", name),
    }
    return bool({word.lower() for word in words} & set(_WORDS[kind]))


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
