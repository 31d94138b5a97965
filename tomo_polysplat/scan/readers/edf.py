"""EDF, the ESRF data format: pictures, each a header of ``key = value ;`` lines in braces and its numbers after it."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.files import existing_file

__all__ = ["EdfFrames"]

_MOST_HEADER = 1 << 16
# Names of the types in capitals, as the format's description and fabio have them, without "VALUE".
_TYPES = {
    "SIGNEDBYTE": "i1",
    "UNSIGNEDBYTE": "u1",
    "SIGNEDSHORT": "i2",
    "UNSIGNEDSHORT": "u2",
    "SIGNEDINTEGER": "i4",
    "UNSIGNEDINTEGER": "u4",
    "SIGNEDLONG": "i4",
    "UNSIGNEDLONG": "u4",
    "SIGNED64": "i8",
    "UNSIGNED64": "u8",
    "FLOAT": "f4",
    "REAL": "f4",
    "DOUBLE": "f8",
    "SHORT": "i2",
    "INTEGER": "i4",
    "LONG": "i4",
    "BYTE": "u1",
}


class EdfFrames:
    """Pictures of EDF files, one or more in each, all of one size.

    Raises
    ------
    ValueError
        For files that are none, compressed ones, and pictures of different sizes or types.
    """

    def __init__(self, files: Iterable[Path]) -> None:
        self._places = [
            (file, offset) for path in files for file, offset, _, _ in _pictures(path, self._require)
        ]
        if not self._places:
            raise fail("path", "EDF pictures", "none")
        self.shape = (len(self._places), *self._size)

    def read(self, index: int, rows: slice, columns: slice) -> np.ndarray:
        """Part of one picture."""
        file, offset = self._places[index]
        return np.array(np.memmap(file, self.dtype, "r", offset, self._size)[rows, columns])

    def _require(self, file: Path, size: tuple[int, int], dtype: np.dtype) -> None:
        if not hasattr(self, "_size"):
            self._size, self.dtype = size, dtype
        elif (size, dtype) != (self._size, self.dtype):
            raise fail("path", f"pictures of {self.dtype} of {self._size}", f"{dtype} of {size} in {file}")


def _pictures(path: Path, require):  # type: ignore[no-untyped-def]
    """File, first byte, size and type of each picture; every one is shown to `require`."""
    file = existing_file(path)
    total, start = file.stat().st_size, 0
    while start < total:
        header, begin = _header(file, start)
        if header is None:
            return
        size, dtype = _size_and_type(file, header)
        require(file, size, dtype)
        count = int(np.prod(size)) * dtype.itemsize
        if begin + count > total:
            raise fail(
                "path", f"{count} bytes of a picture", f"{total - begin} in {file}", "copy the file again"
            )
        yield file, begin, size, dtype
        start = begin + max(count, _whole(header.get("SIZE", "")))


def _header(file: Path, start: int) -> tuple[dict[str, str] | None, int]:
    """The entries of the header that begins there, in capitals, and where its numbers begin."""
    with open(file, "rb") as stream:
        stream.seek(start)
        text = stream.read(_MOST_HEADER)
    opened = re.match(rb"[\s\0]*\{", text)
    if opened is None:
        if start:  # what is behind the last picture is no picture
            return None, start
        raise fail("path", "an EDF file, which begins with {", str(file))
    end = re.compile(rb"\}[ \r]*\n").search(text, opened.end())
    if end is None:
        raise fail("path", "an EDF header", f"one without an end in {file}", "copy or write the file again")
    inside = text[opened.end() : end.start()].decode("latin-1").split(";")
    entries = [entry.partition("=") for entry in inside if "=" in entry]
    return {key.strip().upper(): value.strip() for key, _, value in entries}, start + end.end()


def _size_and_type(file: Path, header: dict[str, str]) -> tuple[tuple[int, int], np.dtype]:
    name = header.get("DATATYPE", "").upper().replace("VALUE", "")
    sides = [header.get(key, "") for key in ("DIM_2", "DIM_1")]
    if header.get("COMPRESSION", "NONE").upper() not in ("NONE", ""):
        raise fail(
            "path", "EDF pictures that are not compressed", header["COMPRESSION"], "write them again without"
        )
    if name not in _TYPES or not all(0 < _whole(side) < 2**31 for side in sides):
        got = f"DataType {header.get('DATATYPE', 'none')}, Dim_2 {sides[0] or 'none'}, Dim_1 {sides[1] or 'none'}"
        raise fail("path", "EDF pictures of numbers, of two axes", f"{got} in {file}")
    order = ">" if header.get("BYTEORDER", "LowByteFirst").upper().startswith("HIGH") else "<"
    return (int(sides[0]), int(sides[1])), np.dtype(order + _TYPES[name])


def _whole(text: str) -> int:
    """A number of so many digits as a size may have, or 0."""
    return int(text) if text.isdecimal() and len(text) < 16 else 0
