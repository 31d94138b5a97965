"""The heaps in which HDF5 keeps texts and what virtual datasets are made of, read without HDF5.

HDF5 (2.0 and earlier) walks a heap from object to object by the sizes that it states, and never ends where one
is 0. No exception and no Ctrl-C gets out of that. It also takes as much memory as a text states to be long,
before it looks how long it is. So what a file refers to is looked up here, where both are checked, and only then:
the size of the file does not matter. The layout is that of the HDF5 file format specification, section III.E.
"""

from __future__ import annotations

from typing import BinaryIO

from tomo_polysplat.checks import fail

__all__ = ["heap_object", "referred_text", "require_plain_start"]

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
# Version 1 and three reserved bytes.
_COLLECTION = b"GCOL\x01"
# Of a collection and of an object, with lengths of 8 bytes.
_HEADER = 16
# An object is known by a number of two bytes.
_MOST_OBJECTS = 2**16
# Of a text: ten times what `tomo_polysplat.json_text` takes.
_LONGEST = 2**26
_REMEDY = "the file is damaged: copy or write it again"


def require_plain_start(stream: BinaryIO, where: str) -> None:
    """Refuse what is not HDF5 from its first byte on, or has addresses or lengths of other than 8 bytes."""
    start = stream.read(2 * _HEADER)
    if len(start) < 2 * _HEADER or start[:8] != _SIGNATURE:
        raise fail("path", "a readable HDF5 file", where, "it is not HDF5, or truncated")
    sizes = start[13:15] if start[8] < 2 else start[9:11]
    if sizes != b"\x08\x08":
        raise fail("path", "a readable HDF5 file", f"{where} with lengths of {tuple(sizes)} bytes", _REMEDY)


def referred_text(stream: BinaryIO, where: str, reference: bytes) -> bytes:
    """The text that a reference of 16 bytes (length, address, index) stands for.

    Raises
    ------
    ValueError
        If it is longer than what it refers to, or that is no object of a sound heap.
    """
    length, address, index = (
        int.from_bytes(reference[a:b], "little") for a, b in ((0, 4), (4, 12), (12, 16))
    )
    if length == 0:
        return b""
    if length > _LONGEST:
        raise fail(where, f"a text of at most {_LONGEST} bytes", f"{length}", _REMEDY)
    return heap_object(stream, where, address, index, length)


def heap_object(stream: BinaryIO, where: str, address: int, index: int, length: int | None = None) -> bytes:
    """An object of the collection at `address`, or its first `length` bytes.

    All of the collection is walked, as HDF5 does.

    Raises
    ------
    ValueError
        Unless its objects follow each other up to its end, and the one of that `index` is so long.
    """
    found = None
    end = stream.seek(0, 2)
    head = _at(stream, address, end)
    size = int.from_bytes(head[8:], "little")
    at, count = _HEADER, 0
    sound = head.startswith(_COLLECTION) and address + size <= end
    while sound and at + _HEADER <= size:
        header = _at(stream, address + at, end)
        number, stated = int.from_bytes(header[:2], "little"), int.from_bytes(header[8:], "little")
        # The length of free space, object 0, counts its header; other objects are padded to 8 bytes.
        step = stated if number == 0 else _HEADER + -(-stated // 8) * 8
        sound = step >= _HEADER and at + step <= size and count < _MOST_OBJECTS
        if number == index and number:
            found = address + at + _HEADER, stated
        at, count = at + step, count + 1
    if not sound:
        raise fail(where, "data in a sound heap", "a damaged heap", _REMEDY)
    if found is None or found[1] < (length or 0):
        raise fail(where, f"{length} bytes of a heap", f"{found[1] if found else 'nothing'}", _REMEDY)
    stream.seek(found[0])
    return stream.read(found[1] if length is None else length)


def _at(stream: BinaryIO, place: int, end: int) -> bytes:
    if place + _HEADER > end:
        return bytes(_HEADER)
    stream.seek(place)
    return stream.read(_HEADER)
