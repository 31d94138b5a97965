"""MetaImage, the .mha and .mhd files of ITK's and RTK's: a header of ``key = value`` lines, and the numbers.

Keys and types are those of MetaIO's description (https://itk.org/Wiki/MetaIO/Documentation). Numbers as text, and
lists of files, are not read.
"""

from __future__ import annotations

import math
import zlib
from pathlib import Path

import numpy as np

from tomo_polysplat.checks import fail, require_number
from tomo_polysplat.files import existing_file, require_plausible_size
from tomo_polysplat.scan.readers.frames import ArrayFrames

__all__ = ["METAIMAGE_SUFFIXES", "MetaImageFrames"]

METAIMAGE_SUFFIXES = (".mha", ".mhd")
_MOST_HEADER, _LONGEST_AXIS = 1 << 16, 1 << 31
# MetaIO's long has 4 bytes on every machine.
_TYPES = {
    "CHAR": "i1",
    "UCHAR": "u1",
    "SHORT": "i2",
    "USHORT": "u2",
    "INT": "i4",
    "UINT": "u4",
    "LONG": "i4",
    "ULONG": "u4",
    "LONG_LONG": "i8",
    "ULONG_LONG": "u8",
    "FLOAT": "f4",
    "DOUBLE": "f8",
}
_LAST = "ElementDataFile"
_AGAIN = "copy or write the file again"


class MetaImageFrames:
    """Pictures (pictures, rows, columns) of one file, a picture being its plane of x and y.

    Attributes
    ----------
    origin, spacing : (x, y)
        Of the first pixel's middle, and from pixel to pixel.

    Raises
    ------
    ValueError
        For a file that is none, or is damaged, and for kinds that are not read.
    MemoryError
        If a compressed one is larger than the free memory.
    """

    def __init__(self, path: Path) -> None:
        self._path = existing_file(path)
        header, begin = self._header()
        size = self._whole(header, "DimSize")
        if len(size) not in (2, 3) or header.get("ElementNumberOfChannels", "1") != "1":
            got = f"{len(size)} axes with {header.get('ElementNumberOfChannels', '1')} values each in {path}"
            raise fail("path", "a stack of pictures of grey values", got)
        shape = (*size, 1)[2::-1]
        self.origin = self._two(header, ("Offset", "Position", "Origin"), 0.0)
        self.spacing = self._two(header, ("ElementSpacing", "ElementSize"), 1.0)
        self._frames = ArrayFrames(self._values(header, begin, shape))
        self.shape, self.dtype = self._frames.shape, self._frames.dtype

    def read(self, index: int, rows: slice, columns: slice) -> np.ndarray:
        """Part of one picture."""
        return self._frames.read(index, rows, columns)

    def _header(self) -> tuple[dict[str, str], int]:
        """Its entries, and the byte after it."""
        with open(self._path, "rb") as stream:
            start = stream.read(_MOST_HEADER)
        entries: dict[str, str] = {}
        place = 0
        while _LAST not in entries:
            end = start.find(b"\n", place)
            line = start[place : end if end >= 0 else len(start)]
            key, separator, value = line.decode("latin-1").partition("=")
            if not separator or (end < 0 and len(start) == _MOST_HEADER):
                raise fail("path", f"the header of a MetaImage up to {_LAST}", str(self._path), _AGAIN)
            entries[key.strip()] = value.strip()
            place = end + 1 if end >= 0 else len(start)
        return entries, place

    def _values(self, header: dict[str, str], begin: int, shape: tuple[int, ...]) -> np.ndarray:
        name = header.get("ElementType", "").removeprefix("MET_")
        if name not in _TYPES or not _true(header, "BinaryData"):
            got = f"ElementType {header.get('ElementType', 'none')}, BinaryData {header.get('BinaryData', 'none')}"
            raise fail("path", "binary numbers of one of MetaIO's types", f"{got} in {self._path}")
        big = _true(header, "BinaryDataByteOrderMSB") or _true(header, "ElementByteOrderMSB")
        dtype = np.dtype((">" if big else "<") + _TYPES[name])
        count = math.prod(shape) * dtype.itemsize
        file, begin = self._data(header, begin, count)
        stored = max(0, file.stat().st_size - begin)
        if _true(header, "CompressedData"):
            require_plausible_size(file.name, count, stored)
            return np.frombuffer(self._unpacked(file, begin, count), dtype).reshape(shape)
        if stored < count:
            raise fail("path", f"{count} bytes of numbers", f"{stored} in {file}", _AGAIN)
        return np.memmap(file, dtype, "r", begin, shape)

    def _data(self, header: dict[str, str], begin: int, count: int) -> tuple[Path, int]:
        """The file with the numbers, which is this one or lies beside or below it, and where they begin."""
        name = header[_LAST]
        if name.upper() == "LOCAL":
            return self._path, begin
        folder = self._path.parent.resolve()
        file = (folder / name.replace("\\", "/")).resolve() if "\0" not in name else folder
        if folder not in file.parents:
            raise fail("path", f"{_LAST} of the folder of the header", f"{name!r} in {self._path}")
        before = int(require_number("HeaderSize", header.get("HeaderSize", "0"), at_least=-1, at_most=2**60))
        file = existing_file(file)
        return file, max(0, file.stat().st_size - count) if before == -1 else before

    def _unpacked(self, file: Path, begin: int, count: int) -> bytes:
        with open(file, "rb") as stream:
            stream.seek(begin)
            packed = stream.read()
        try:
            content = zlib.decompressobj().decompress(packed, count)
        except zlib.error as error:
            raise fail("path", "numbers that can be unpacked", f"{file} ({error})", _AGAIN) from error
        if len(content) < count:
            raise fail("path", f"{count} bytes of numbers", f"{len(content)} in {file}", _AGAIN)
        return content

    def _whole(self, header: dict[str, str], key: str) -> list[int]:
        words = header.get(key, "").split()
        if not all(word.isascii() and word.isdecimal() and len(word) < 12 for word in words):
            raise fail("path", f"whole numbers as {key}", f"{header[key][:60]!r} in {self._path}", _AGAIN)
        size = [int(word) for word in words]
        if not all(0 < n < _LONGEST_AXIS for n in size) or header.get("NDims") != str(len(size)):
            got = f"{size} with NDims {header.get('NDims', 'none')[:20]} in {self._path}"
            raise fail("path", f"NDims whole numbers above 0 as {key}", got, _AGAIN)
        return size

    def _two(self, header: dict[str, str], keys: tuple[str, ...], otherwise: float) -> tuple[float, float]:
        key = next((key for key in keys if key in header), None)
        if key is None:
            return otherwise, otherwise
        words = header[key].split()[:2]
        if len(words) != 2:
            raise fail(
                "path", f"two numbers or more as {key}", f"{header[key][:60]!r} in {self._path}", _AGAIN
            )
        x, y = (require_number(key, word) for word in words)
        return x, y


def _true(header: dict[str, str], key: str) -> bool:
    """Whether a key says True."""
    return header.get(key, "False").lower()[:1] in ("t", "1")
