"""Single pictures of a Zeiss Xradia's, one .xrm file a view, taken together as one .txrm file is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.scan.readers.compound import CompoundFile
from tomo_polysplat.scan.readers.picture_names import has_word, in_order
from tomo_polysplat.scan.readers.xradia_frames import XrmFrames, picture_names

__all__ = ["PER_PICTURE", "SeriesFrames", "XrmSeries", "sorted_out"]

# What each picture tells of itself.
PER_PICTURE = (
    "ImageInfo/Angles",
    "ImageInfo/ExpTimes",
    "ImageInfo/StoRADistance",
    "ImageInfo/DtoRADistance",
    "Alignment/X-Shifts",
    "Alignment/Y-Shifts",
)


def sorted_out(files: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Pictures of the object and of the open beam, in order; those of the dark are left out."""
    flats = [file for file in files if has_word(file.stem, "flats")]
    left = [file for file in files if file not in flats and not has_word(file.stem, "darks")]
    return in_order(left), in_order(flats)


class XrmSeries:
    """Files of one picture each, which tell what a `CompoundFile` of all pictures would.

    They are opened one after the other, since a process may not have thousands of files open.

    Parameters
    ----------
    files : sequence of Path
        One a view, in order.

    Raises
    ------
    ValueError
        For a file that holds more than one picture, or none.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self.files, self._first = list(files), CompoundFile(files[0])
        self.path = self._first.path.parent
        each: dict[str, list[float]] = {name: [] for name in PER_PICTURE}
        for path in self.files:
            file = CompoundFile(path)
            if len(names := picture_names(file)) != 1:
                got = f"{len(names)} in {path}"
                raise fail("path", "one picture in each of several .xrm files", got, "name one file")
            for name, found in each.items():
                value = file.number(name)
                found.append(np.nan if value is None else value)
        self._each = {name: np.array(found, np.float32) for name, found in each.items()}

    def __contains__(self, name: str) -> bool:
        return name in self._first

    def stream(self, name: str, most: int | None = None) -> bytes:
        """Of the first file."""
        return self._first.stream(name) if most is None else self._first.stream(name, most)

    def numbers(self, name: str, dtype: str = "<f4") -> np.ndarray:
        """One a file of what each picture tells (NaN where one does not), else those of the first file."""
        if name in self._each and name in self._first:
            return self._each[name]
        return self._first.numbers(name, dtype)

    def number(self, name: str, dtype: str = "<f4") -> float | None:
        """The first number, as `CompoundFile.number` has it."""
        return self._first.number(name, dtype)

    def text(self, name: str) -> str:
        """The text of the first file."""
        return self._first.text(name)

    def texts(self, name: str) -> list[str]:
        """The texts of the first file."""
        return self._first.texts(name)


class SeriesFrames:
    """Pictures of files of one each, which are opened when they are asked for.

    Parameters
    ----------
    files : sequence of Path
    light : array, shape (pictures,), optional
        What the counts of each are multiplied by.
    """

    def __init__(self, files: Sequence[Path], light: np.ndarray | None = None) -> None:
        self._files, self._light = list(files), light
        first = self._frames(0)
        self.dtype, self.shape = first.dtype, (len(files), *first.shape[1:])

    def _frames(self, index: int) -> XrmFrames:
        file = CompoundFile(self._files[index])
        light = None if self._light is None else self._light[index : index + 1]
        return XrmFrames(file, picture_names(file)[:1], "ImageInfo/DataType", light)

    def read(self, index: int, rows: slice, columns: slice) -> np.ndarray:
        """Part of one picture."""
        frames = self._frames(index)
        if frames.shape[1:] != self.shape[1:] or frames.dtype != self.dtype:
            got = f"{frames.dtype} of {frames.shape[1:]} in {self._files[index]}"
            raise fail("path", f"{self.dtype} of {self.shape[1:]} as in {self._files[0].name}", got)
        return frames.read(0, rows, columns)
