"""What the header of an HDF5 object says, read without HDF5.

Of some things that a header states HDF5 takes memory or goes round in circles before it checks them. They are
looked at here first. The layout is that of the HDF5 file format specification, sections IV.A.1 (object headers)
and IV.A.2 (messages).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

__all__ = ["Layout", "attribute_bytes", "layout"]

_LAYOUT, _ATTRIBUTE, _CONTINUATION = 0x08, 0x0C, 0x10
_SHARED = 2
COMPACT, VIRTUAL = 0, 3
# Bytes of messages in blocks of their own; more than an honest object has of either.
_MOST_BYTES, _MOST_BLOCKS = 2**24, 1000


class Layout(NamedTuple):
    """How a dataset is stored.

    Attributes
    ----------
    kind : int
        0 compact, 1 contiguous, 2 chunked, 3 virtual.
    data : bytes
        All of a compact dataset; nothing of others.
    heap : (address, index) or None
        Where a virtual dataset keeps what it is made of.
    """

    kind: int
    data: bytes = b""
    heap: tuple[int, int] | None = None


def layout(stream: BinaryIO, address: int) -> Layout | None:
    """How the dataset whose header is at `address` is stored; None for anything else or older than HDF5 1.6."""
    for kind, _, body in _messages(stream, address):
        if kind != _LAYOUT or len(body) < 4 or body[0] < 3:
            continue
        if body[1] == COMPACT:
            size = int.from_bytes(body[2:4], "little")
            return Layout(COMPACT, body[4 : 4 + size])
        if body[1] == VIRTUAL and len(body) >= 14:
            return Layout(VIRTUAL, heap=(_number(body, 2, 8), _number(body, 10, 4)))
        return Layout(body[1])
    return None


def attribute_bytes(stream: BinaryIO, address: int, name: str) -> bytes | None:
    """The value of an attribute as it is stored, with what pads it.

    None if the header does not hold it: it may lie in a heap of attributes.
    """
    wanted = name.encode() + b"\0"
    for kind, flags, body in _messages(stream, address):
        if kind != _ATTRIBUTE or flags & _SHARED or len(body) < 8:
            continue
        version, sizes = body[0], [_number(body, at, 2) for at in (2, 4, 6)]
        at, pad = (9 if version == 3 else 8), (8 if version == 1 else 1)
        if body[at : at + sizes[0]] == wanted:
            return body[at + sum(-(-size // pad) * pad for size in sizes) :]
    return None


def _messages(stream: BinaryIO, address: int) -> Iterator[tuple[int, int, bytes]]:
    """Type, flags and body of each message of an object; none where there is no object."""
    start = _read(stream, address, 64)
    if start[:5] == b"OHDR\x02":
        flags = start[5]
        at = 6 + 16 * bool(flags & 0x20) + 4 * bool(flags & 0x10)
        width = 1 << (flags & 3)
        blocks = [(address + at + width, _number(start, at, width))]
        size_of_head, new = 4 + 2 * bool(flags & 4), True
    elif start[:1] == b"\x01":
        blocks, size_of_head, new = [(address + 16, _number(start, 8, 4))], 8, False
    else:
        return
    left = _MOST_BYTES
    for number, (place, length) in enumerate(blocks):
        left -= length
        if left < 0 or number > _MOST_BLOCKS:
            return
        block = _read(stream, place, length)
        at = 4 if new and number else 0
        end = len(block) - (4 if new and number else 0)
        while at + size_of_head <= end:
            kind = block[at] if new else _number(block, at, 2)
            size = _number(block, at + (1 if new else 2), 2)
            flags = block[at + (3 if new else 4)]
            body = block[at + size_of_head : min(at + size_of_head + size, end)]
            if kind == _CONTINUATION and len(body) >= 16:
                blocks.append((_number(body, 0, 8), _number(body, 8, 8)))
            yield kind, flags, body
            at += size_of_head + size


def _read(stream: BinaryIO, place: int, length: int) -> bytes:
    if place >= 1 << 63:
        return b""
    stream.seek(place)
    return stream.read(length)


def _number(content: bytes, at: int, size: int) -> int:
    return int.from_bytes(content[at : at + size], "little")
