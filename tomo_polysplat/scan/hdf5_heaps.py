"""The heaps in which HDF5 keeps texts, looked through before HDF5 does.

HDF5 (2.0 and earlier) walks a heap from object to object by the sizes that it states, and never ends where one
is 0. No exception and no Ctrl-C gets out of that, so a damaged heap has to be found first. The layout is that of
the HDF5 file format specification, section III.E, "Global Heap".
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

from tomo_polysplat.checks import fail

__all__ = ["require_sound_heaps"]

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
# Signature, version and reserved bytes of a collection of objects.
_COLLECTION = b"GCOL\x01\x00\x00\x00"
# Of a collection and of an object, with lengths of 8 bytes.
_HEADER = 16
_BLOCK = 2**24
# Times that all the heaps of a file may walk over all of it: one that lies inside another is walked by both.
_MOST_WALKS = 4
_REMEDY = "it is damaged: copy or write it again"


def require_sound_heaps(file: Path) -> None:
    """Refuse an HDF5 file that HDF5 would not return from.

    Raises
    ------
    ValueError
        If it is not HDF5 from its first byte on, has lengths of other than 8 bytes, or a heap whose objects do
        not follow each other, or so many heaps within heaps that to look through them would take long.
    """
    with open(file, "rb") as stream:
        start = stream.read(2 * _HEADER)
        if len(start) < 2 * _HEADER or start[:8] != _SIGNATURE:
            raise fail("path", "a readable HDF5 file", f"{file}", "it is not HDF5, or truncated")
        sizes = start[13:15] if start[8] < 2 else start[9:11]
        if sizes != b"\x08\x08":
            raise fail(
                "path", "a readable HDF5 file", f"{file} with lengths of {tuple(sizes)} bytes", _REMEDY
            )
        file_size = file.stat().st_size
        left = _MOST_WALKS * file_size // _HEADER
        for place in _places(stream):
            objects = _objects(stream, place, file_size)
            if objects is None:
                raise fail("path", "a readable HDF5 file", f"{file} with a damaged heap", _REMEDY)
            left -= objects
            if left < 0:
                raise fail("path", "a readable HDF5 file", f"{file} with heaps within heaps", _REMEDY)


def _places(stream: BinaryIO) -> list[int]:
    """Where collections begin, or what looks so."""
    places, begin, overlap = [], 0, b""
    stream.seek(0)
    while block := stream.read(_BLOCK):
        block = overlap + block
        at = block.find(_COLLECTION)
        while at >= 0:
            places.append(begin + at)
            at = block.find(_COLLECTION, at + 1)
        overlap = block[1 - len(_COLLECTION) :]
        begin += len(block) - len(overlap)
    return places


def _objects(stream: BinaryIO, place: int, file_size: int) -> int | None:
    """How many objects a collection has, or None unless each leads to the next, up to its end."""
    stream.seek(place + 8)
    size = int.from_bytes(stream.read(8), "little")
    if place + size > file_size:
        # HDF5 notices this by itself.
        return 0
    at, count = _HEADER, 0
    while at + _HEADER <= size:
        stream.seek(place + at)
        header = stream.read(_HEADER)
        index, length = int.from_bytes(header[:2], "little"), int.from_bytes(header[8:], "little")
        # The length of free space, object 0, counts its header; other objects are padded to 8 bytes.
        step = length if index == 0 else _HEADER + -(-length // 8) * 8
        if step < _HEADER or at + step > size:
            return None
        at, count = at + step, count + 1
    return count
