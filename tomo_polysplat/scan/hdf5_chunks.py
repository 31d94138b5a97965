"""Chunks of HDF5 datasets, unpacked with a bound.

HDF5 unpacks a chunk to whatever it holds, reads beyond one that is too short for its filter, and one thread does
it all. Here what a chunk may hold is known before, and the threads of the CPU share the chunks. The filters are
those of the HDF5 library: deflate (zlib), shuffle and fletcher32, as the "Filter Pipeline" of the file format
specification (section IV.A.2.l) numbers them.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.parallel import run_tasks

if TYPE_CHECKING:
    import h5py

__all__ = ["UNPACKED_HERE", "Chunk", "Filters", "chunk_bytes", "chunk_table", "filters_of", "read_chunks"]

_DEFLATE, _SHUFFLE, _FLETCHER = 1, 2, 3
UNPACKED_HERE = frozenset((_DEFLATE, _SHUFFLE, _FLETCHER))
# What a filter may add to data that cannot be packed, beside doubling them.
_SLACK = 1024
# Of packed chunks that wait for a thread.
_AT_ONCE = 2**26
_SUMMED_AT_ONCE = 2**20
_REMEDY = "the file is damaged: copy or write it again"

Filters = tuple[tuple[int, tuple[int, ...]], ...]
# Start, stop and step of each axis, the step above 0.
Box = tuple[range, ...]


class Chunk(NamedTuple):
    """Where a chunk is stored: bit k of ``skipped`` says that filter k was left out."""

    skipped: int
    place: int
    size: int


def filters_of(dataset: h5py.Dataset) -> Filters:
    """Number and parameters of each filter, in the order of writing."""
    plist = dataset.id.get_create_plist()
    found = (plist.get_filter(number) for number in range(plist.get_nfilters()))
    return tuple((number, tuple(values)) for number, _, values, _ in found)


def chunk_table(
    dataset: h5py.Dataset, where: str, file_size: int, item_bytes: int
) -> dict[tuple[int, ...], Chunk]:
    """All chunks by the index of their first element, compared with the file and with each other.

    Raises
    ------
    ValueError
        If one lies outside the dataset or the file, is larger than what it is to hold, or if they overlap.
    """
    found: list[tuple[tuple[int, ...], Chunk]] = []
    shape, chunks = dataset.shape, dataset.chunks
    most = math.prod(-(-length // size) for length, size in zip(shape, chunks))

    def keep(info: h5py.h5d.StoreInfo) -> bool | None:
        found.append((tuple(info.chunk_offset), Chunk(info.filter_mask, info.byte_offset, info.size)))
        return True if len(found) > most else None

    # Without chunk_iter HDF5 is older than 1.12.3, and looks for each from the first on.
    if hasattr(dataset.id, "chunk_iter"):
        dataset.id.chunk_iter(keep)
    else:
        for number in range(min(dataset.id.get_num_chunks(), most + 1)):
            keep(dataset.id.get_chunk_info(number))
    packed = bool(filters_of(dataset))
    largest = math.prod(chunks) * item_bytes
    table = dict(found)
    good = len(table) == len(found) <= most and sum(chunk.size for chunk in table.values()) <= file_size
    for first, (_, place, size) in table.items():
        good = good and all(at % step == 0 and at < end for at, step, end in zip(first, chunks, shape))
        good = good and place + size <= file_size
        good = good and (0 < size <= 2 * largest + _SLACK if packed else size == largest)
    if not good:
        raise fail(where, "chunks that fit into the dataset and the file", "others", _REMEDY)
    return table


def read_chunks(
    dataset: h5py.Dataset, where: str, table: Mapping[tuple[int, ...], Chunk], box: Box, out: np.ndarray
) -> None:
    """Fill `out`, of the shape of `box`, with what the chunks have of it."""
    filters, chunks = filters_of(dataset), dataset.chunks
    tasks, waiting = [], 0
    for first, chunk in table.items():
        parts = [_overlap(wanted, at, at + size) for wanted, at, size in zip(box, first, chunks)]
        if any(part is None for part in parts):
            continue
        _, content = dataset.id.read_direct_chunk(first)
        targets, sources = zip(*(part for part in parts if part is not None))
        tasks.append((where, content, chunk.skipped, filters, dataset.dtype, chunks, out, targets, sources))
        waiting += len(content)
        if waiting > _AT_ONCE:
            run_tasks(_unpack_into, tasks)
            tasks, waiting = [], 0
    run_tasks(_unpack_into, tasks)


def chunk_bytes(dataset: h5py.Dataset, where: str, item_bytes: int) -> bytes | None:
    """All of a dataset of one chunk, as it is stored, `item_bytes` an item; None if it was not written.

    Raises
    ------
    ValueError
        If there are more chunks, or the filters are not those of this module.
    """
    filters, size = filters_of(dataset), math.prod(dataset.chunks) * item_bytes
    if size > _AT_ONCE or not {number for number, _ in filters} <= UNPACKED_HERE:
        raise fail(where, "a short text", f"chunks of {size} bytes, filters {filters}")
    file_size = Path(dataset.file.filename).stat().st_size
    for first, chunk in chunk_table(dataset, where, file_size, item_bytes).items():
        content = dataset.id.read_direct_chunk(first)[1]
        return unpacked(where, content, chunk.skipped, filters, size)
    return None


def _overlap(wanted: range, low: int, high: int) -> tuple[slice, slice] | None:
    """Where the indices of a range that lie in [low, high) are: in the range, and counted from `low`."""
    first = max(0, -(-(low - wanted.start) // wanted.step))
    last = min(len(wanted), -(-(high - wanted.start) // wanted.step))
    if first >= last:
        return None
    source = wanted[first:last]
    return slice(first, last), slice(source[0] - low, source[-1] - low + 1, wanted.step)


# The arguments of a task that threads share out.
def _unpack_into(where, content, skipped, filters, dtype, chunks, out, targets, sources) -> None:  # type: ignore[no-untyped-def]
    content = unpacked(where, content, skipped, filters, math.prod(chunks) * dtype.itemsize)
    out[targets] = np.frombuffer(content, dtype).reshape(chunks)[sources]


def unpacked(where: str, content: bytes, skipped: int, filters: Filters, size: int) -> bytes:
    """A chunk of `size` bytes, from what is stored of it.

    Raises
    ------
    ValueError
        If it holds more or less, or its check sum does not agree.
    """
    for number in reversed(range(len(filters))):
        kind, values = filters[number]
        if skipped >> number & 1:
            continue
        if kind == _DEFLATE:
            content = _inflated(where, content, 2 * size + _SLACK)
        elif kind == _SHUFFLE:
            content = _unshuffled(content, values[0] if values else 1)
        else:
            content = _verified(where, content)
    if len(content) != size:
        raise fail(where, f"chunks of {size} bytes", f"one of {len(content)}", _REMEDY)
    return content


def _inflated(where: str, content: bytes, most: int) -> bytes:
    stream = zlib.decompressobj()
    try:
        found = stream.decompress(content, most)
    except zlib.error as error:
        raise fail(where, "chunks packed by deflate", str(error), _REMEDY) from error
    if not stream.eof:
        raise fail(where, f"chunks of at most {most} bytes", "a longer or a truncated one", _REMEDY)
    return found


def _unshuffled(content: bytes, width: int) -> bytes:
    """Bytes sorted back from all first bytes of the numbers, all second bytes and so on."""
    count = len(content) // max(width, 1)
    if width < 2 or count < 2:
        return content
    whole = np.frombuffer(content, np.uint8, width * count).reshape(width, count)
    return whole.T.tobytes() + content[width * count :]


def _verified(where: str, content: bytes) -> bytes:
    """What stands before the check sum, which is that of J. Fletcher, IEEE Trans. Commun. 30 (1982) 247."""
    if len(content) < 4:
        raise fail(where, "chunks with their check sum", f"one of {len(content)} bytes", _REMEDY)
    data, stated = content[:-4], int.from_bytes(content[-4:], "little")
    sums = _fletcher(data)
    # HDF5 before 1.6.3 wrote the bytes of both sums the other way round.
    halves = stated & 0xFFFF, stated >> 16
    swapped = tuple((half & 0xFF) << 8 | half >> 8 for half in halves)
    if sums not in (tuple(half % 65535 for half in halves), tuple(half % 65535 for half in swapped)):
        raise fail(where, "data that agree with their check sum", "others", _REMEDY)
    return data


def _fletcher(data: bytes) -> tuple[int, int]:
    """Both sums over the words of two bytes, the higher first, modulo 65535."""
    simple = double = 0
    for first in range(0, len(data), _SUMMED_AT_ONCE):
        part = data[first : first + _SUMMED_AT_ONCE]
        words = np.frombuffer(part + b"\0" * (len(part) % 2), ">u2").astype(np.uint64)
        weights = np.arange(len(words), 0, -1, dtype=np.uint64)
        double += len(words) * simple + int((words * weights).sum())
        simple += int(words.sum())
    return simple % 65535, double % 65535
