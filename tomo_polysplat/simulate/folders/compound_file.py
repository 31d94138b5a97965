"""A compound file (OLE2) of some streams, in version 3 of the format (MS-CFB, Microsoft's published specification)."""

from __future__ import annotations

import struct
from collections.abc import Mapping

from tomo_polysplat.checks import fail

__all__ = ["compound_file"]

_SECTOR, _MINI, _CUTOFF, _ENTRY = 512, 64, 4096, 128
_FREE, _END, _FAT = 0xFFFFFFFF, 0xFFFFFFFE, 0xFFFFFFFD
# Sectors of the table that the header has room for.
_MOST_FAT = 109
_STORAGE, _STREAM, _ROOT = 1, 2, 5


def compound_file(streams: Mapping[str, bytes]) -> bytes:
    """The bytes of a file with these streams; a name before a slash is that of a folder.

    Raises
    ------
    ValueError
        For more than 7 MB, which need tables that are not written here.
    """
    chain: list[int] = []
    mini_chain: list[int] = []
    sectors, mini = bytearray(), bytearray()
    places = {}
    for name, content in streams.items():
        small = len(content) < _CUTOFF
        places[name] = (
            _put(mini, mini_chain, content, _MINI) if small else _put(sectors, chain, content, _SECTOR)
        )
    container = _put(sectors, chain, bytes(mini), _SECTOR)
    table = struct.pack(f"<{len(mini_chain)}I", *mini_chain)
    minis = _put(sectors, chain, table + b"\xff" * (-len(table) % _SECTOR), _SECTOR)
    entries = _directory(streams, places, (container, len(mini)))
    directory = _put(sectors, chain, entries, _SECTOR)
    own = 0
    while (len(chain) + own) * 4 > own * _SECTOR:
        own += 1
    if own > _MOST_FAT:
        raise fail("streams", "at most 7 MB", f"{len(sectors)} bytes")
    first = len(chain)
    chain += [_FAT] * own
    fat = struct.pack(f"<{len(chain)}I", *chain)
    fat += b"\xff" * (own * _SECTOR - len(fat))
    counts = (own, directory, 0, _CUTOFF, minis, -(-len(table) // _SECTOR), _END, 0)
    header = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(16)
    header += struct.pack("<HHHHH6xI", 0x3E, 3, 0xFFFE, 9, 6, 0) + struct.pack("<8I", *counts)
    header += struct.pack(f"<{own}I", *range(first, first + own)) + b"\xff" * (4 * (_MOST_FAT - own))
    return header + bytes(sectors) + fat


def _put(sectors: bytearray, chain: list[int], content: bytes, size: int) -> int:
    """Append `content` in whole sectors and their chain; the first one's number."""
    count = -(-len(content) // size)
    if not count:
        return _END
    first = len(chain)
    chain += [*range(first + 1, first + count), _END]
    sectors += content + bytes(-len(content) % size)
    return first


def _directory(streams: Mapping[str, bytes], places: Mapping[str, int], mini: tuple[int, int]) -> bytes:
    """Entries of the root, the folders and the streams; those of a folder make a tree of sorted names."""
    folders = sorted({name[:k] for name in streams for k, sign in enumerate(name) if sign == "/"})
    names = ["", *folders, *streams]
    links = {name: [_FREE, _FREE, _FREE] for name in names}
    for folder in ["", *folders]:
        inside = [name for name in names[1:] if name.rpartition("/")[0] == folder]
        inside.sort(key=lambda name: (len(_last(name)), _last(name).upper()))
        links[folder][2] = _tree(inside, names, links)
    entries = [_entry("Root Entry", _ROOT, links[""], *mini)]
    for name in names[1:]:
        if name in streams:
            entries.append(_entry(_last(name), _STREAM, links[name], places[name], len(streams[name])))
        else:
            entries.append(_entry(_last(name), _STORAGE, links[name], 0, 0))
    spare = _entry("", 0, [_FREE, _FREE, _FREE], 0, 0)
    return b"".join(entries) + spare * (-len(entries) % (_SECTOR // _ENTRY))


def _tree(inside: list[str], names: list[str], links: dict[str, list[int]]) -> int:
    """A balanced tree of sorted names; the number of its root."""
    if not inside:
        return _FREE
    middle = len(inside) // 2
    links[inside[middle]][0] = _tree(inside[:middle], names, links)
    links[inside[middle]][1] = _tree(inside[middle + 1 :], names, links)
    return names.index(inside[middle])


def _last(name: str) -> str:
    return name.rpartition("/")[2]


def _entry(name: str, kind: int, links: list[int], first: int, size: int) -> bytes:
    text = name.encode("utf-16-le")
    length = len(text) + 2 if name else 0
    # Black, as all may be in a balanced tree that nobody adds to.
    return text.ljust(64, b"\0") + struct.pack("<HBB3I36x2II", length, kind, 1, *links, first, size, 0)
