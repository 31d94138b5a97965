"""The pictures of a Zeiss Xradia's .txrm or .xrm file, a stream each."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.scan.readers.compound import CompoundFile

__all__ = [
    "XrmFrames",
    "picture_names",
    "picture_size",
    "reference_names",
    "reference_seconds",
    "xrm_pictures",
]

# Numbers of the types of Xradia's that pictures come in.
_TYPES = {3: "u1", 4: "<i2", 5: "<u2", 6: "<i4", 7: "<u4", 10: "<f4", 11: "<f8"}
# The usual types of so many bytes.
_USUAL = {1: 3, 2: 5, 4: 10, 8: 11}
# Pictures in one folder of streams.
_HUNDRED = 100
_MOST_SIDE, _MOST_PICTURES = 1 << 16, 1 << 20


class XrmFrames:
    """Pictures of one size in streams of a compound file, read when they are asked for.

    Parameters
    ----------
    file : CompoundFile
    names : sequence of str
        Of their streams.
    kind : str
        Of the stream that tells their type; where there is none, their bytes do.
    light : array, shape (pictures,), optional
        What the counts of each are multiplied by.
    """

    def __init__(
        self, file: CompoundFile, names: Sequence[str], kind: str, light: np.ndarray | None = None
    ) -> None:
        sides = picture_size(file)
        told = file.number(kind, "<i4")
        if told is None and names and 0 < sides[0] < _MOST_SIDE and 0 < sides[1] < _MOST_SIDE:
            told = _USUAL.get((file.size(names[0]) or 0) // (sides[0] * sides[1]))
        if not names or not all(0 < side < _MOST_SIDE for side in sides) or told not in _TYPES:
            got = f"{len(names)} of {sides[0]} x {sides[1]} pixels of type {told} in {file.path}"
            raise fail("path", "pictures of numbers", got, "name the .txrm file of the projections")
        self._file, self._names, self._light = file, names, light
        self._stored = np.dtype(_TYPES[int(told)])
        self.dtype = self._stored if light is None else np.dtype(np.float32)
        self.shape = (len(names), sides[0], sides[1])
        self._bytes = self._stored.itemsize * sides[0] * sides[1]

    def read(self, index: int, rows: slice, columns: slice) -> np.ndarray:
        """Part of one picture."""
        name = self._names[index]
        content = self._file.stream(name, most=self._bytes)
        if len(content) != self._bytes:
            got = f"{len(content)} in {self._file.path}"
            raise fail(name, f"{self._bytes} bytes of a picture", got, "copy or write the file again")
        picture = np.frombuffer(content, self._stored).reshape(self.shape[1:])[rows, columns]
        return picture if self._light is None else (picture * self._light[index]).astype(np.float32)


def picture_size(file: CompoundFile, of: str = "") -> tuple[int, int]:
    """Rows and columns of the pictures, or of those without the object."""
    height, width = (
        int(file.number(f"{of}ImageInfo/Image{side}", "<u4") or 0) for side in ("Height", "Width")
    )
    return height, width


def picture_names(file: CompoundFile) -> list[str]:
    """Streams of the pictures that were taken, in folders of a hundred."""
    told = (file.number(f"ImageInfo/{name}", "<u4") for name in ("NoOfImages", "ImagesTaken"))
    count = int(min([_MOST_PICTURES, *(number for number in told if number)]))
    names = (f"ImageData{k // _HUNDRED + 1}/Image{k + 1}" for k in range(count))
    return list(takewhile(lambda name: name in file, names))


def reference_names(file: CompoundFile) -> tuple[list[str], str]:
    """Streams of the pictures without the object, and the one that tells their type.

    None if they are of another size than those of the object.
    """
    of = next(
        (of for of in ("ReferenceData", "MultiReferenceData") if _references(file, of)), "ReferenceData"
    )
    size = picture_size(file, f"{of}/")
    fits = 0 in size or size == picture_size(file)
    return _references(file, of) if fits else [], f"{of}/DataType"


def reference_seconds(file: CompoundFile) -> float | None:
    """Exposure of the pictures without the object."""
    names = ("ExpTime", "ImageInfo/ExpTimes", "ImageInfo/ExpTime")
    found = (file.number(f"{of}/{name}") for of in ("ReferenceData", "MultiReferenceData") for name in names)
    return next((seconds for seconds in found if seconds and seconds > 0), None)


def _references(file: CompoundFile, of: str) -> list[str]:
    names = ["Image"] if of == "ReferenceData" else (f"Image{k + 1}" for k in range(_MOST_PICTURES))
    return list(takewhile(lambda name: name in file, (f"{of}/{name}" for name in names)))


def xrm_pictures(files: Sequence[Path]) -> XrmFrames:
    """The pictures of one such file, as a plain stack has them.

    Raises
    ------
    ValueError
        For several files, and for one without pictures.
    """
    if len(files) > 1:
        raise fail("path", "one .txrm or .xrm file", ", ".join(file.name for file in files))
    file = CompoundFile(files[0])
    return XrmFrames(file, picture_names(file), "ImageInfo/DataType")
