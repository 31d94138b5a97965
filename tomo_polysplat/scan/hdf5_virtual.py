"""Virtual HDF5 datasets: arrays put together from datasets of the same file and of files beside it.

HDF5 would look for these files in several places, some of which the environment names, and put the fill value
where it finds none. Here they are looked for in one place, and a missing one is an error.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.scan.hdf5_chunks import Box
from tomo_polysplat.scan.hdf5_links import dtype_of, member, opened_beside

if TYPE_CHECKING:
    import h5py

__all__ = ["Source", "read_sources", "sources_of"]

_DEEPEST = 4
_MOST_SOURCES = 100_000
_REMEDY = (
    "read it with h5py where its other files are, and write the array that you get into a file: "
    "h5py.File(NEW, 'w')[NAME] = h5py.File(OLD)[NAME][()]"
)


class Stored(Protocol):
    """What is asked of an array in a file; `hdf5_array.StoredArray` is one."""

    dataset: h5py.Dataset
    where: str
    depth: int
    shape: tuple[int, ...]
    file: h5py.File

    def __init__(self, dataset: h5py.Dataset, where: str, depth: int = 0) -> None: ...

    def __getitem__(self, key: Any) -> np.ndarray: ...

    def filled(self, shape: list[int]) -> np.ndarray:
        """An array of what stands where a file has nothing."""
        ...


class Source(NamedTuple):
    """A part of a virtual dataset.

    Attributes
    ----------
    file, name : str
        Where it comes from; ``"."`` is the same file.
    target : tuple of range
        Its indices along each axis of the virtual dataset.
    source : tuple of range, or None
        Those of the dataset that it comes from; None means all.
    size : int
        How many numbers it has.
    """

    file: str
    name: str
    target: Box
    source: Box | None
    size: int


def sources_of(array: Stored) -> list[Source]:
    """What a virtual dataset is made of.

    Raises
    ------
    ValueError
        If its parts grow with other files, or are no regular grids.
    """
    if array.depth >= _DEEPEST:
        raise fail(array.where, f"at most {_DEEPEST} virtual datasets one in another", "more", _REMEDY)
    plist = array.dataset.id.get_create_plist()
    if plist.get_virtual_count() > _MOST_SOURCES:
        raise fail(array.where, f"at most {_MOST_SOURCES} parts", f"{plist.get_virtual_count()}", _REMEDY)
    found = []
    for part in array.dataset.virtual_sources():
        target, source = (_ranges(array.where, space) for space in (part.vspace, part.src_space))
        target = target or tuple(range(length) for length in array.shape)
        if any(axis and axis[-1] >= length for axis, length in zip(target, array.shape)):
            raise fail(array.where, "parts that lie inside it", "others", _REMEDY)
        count = math.prod(len(axis) for axis in target)
        found.append(Source(str(part.file_name), str(part.dset_name), target, source, count))
    return found


def _ranges(where: str, space: h5py.h5s.SpaceID) -> Box | None:
    """Indices along each axis of a selection; None if it is all."""
    import h5py

    kind = space.get_select_type()
    if kind == h5py.h5s.SEL_ALL:
        return None
    if kind != h5py.h5s.SEL_HYPERSLABS or not space.is_regular_hyperslab():
        raise fail(where, "parts that are regular grids", "others", _REMEDY)
    axes = []
    for start, stride, count, block in zip(*map(_unsigned, space.get_regular_hyperslab())):
        if max(count, block, start, stride) >= 2**63:
            raise fail(where, "parts of a known size", "one that grows", _REMEDY)
        if count == 1 or block == stride:
            axes.append(range(start, start + count * block))
        elif block == 1:
            axes.append(range(start, start + count * stride, stride)[:count])
        else:
            raise fail(where, "parts that are regular grids", "blocks with gaps", _REMEDY)
    return tuple(axes)


def _unsigned(numbers: Any) -> list[int]:
    return [int(number) % 2**64 for number in numbers]


def read_sources(array: Stored, sources: list[Source], box: Box) -> np.ndarray:
    """The part `box` of a virtual dataset."""
    out = array.filled([len(axis) for axis in box])
    if box and box[0].step > 1:
        # Frame by frame: what lies between may be most of a large scan.
        for number, index in enumerate(box[0]):
            out[number] = read_sources(array, sources, (range(index, index + 1), *box[1:]))[0]
        return out
    whole = tuple(range(axis.start, axis.stop) if axis else axis for axis in box)
    steps = tuple(slice(None, None, axis.step) for axis in box)
    inner = array.filled([len(axis) for axis in whole]) if whole != box else out
    for source in sources:
        wanted = [_within(axis, asked) for axis, asked in zip(source.target, whole)]
        if all(wanted):
            _copy(array, source, wanted, whole, inner)
    if inner is not out:
        out[...] = inner[steps]
    return out


def _within(axis: range, asked: range) -> range:
    """Positions in `axis` of those of its numbers that `asked`, without gaps, has too."""
    first = max(0, -(-(asked.start - axis.start) // axis.step))
    last = min(len(axis), -(-(asked.stop - axis.start) // axis.step))
    return range(first, last)


def _copy(array: Stored, source: Source, wanted: list[range], box: Box, out: np.ndarray) -> None:
    """Copy the positions `wanted` of a part into `out`, which has the indices `box`."""
    targets = []
    for axis, positions, asked in zip(source.target, wanted, box):
        hit = axis[positions.start : positions.stop]
        targets.append(slice(hit[0] - asked.start, hit[-1] - asked.start + 1, hit.step))
    if source.file == ".":
        values = _values(array, array.file, source, wanted)
    else:
        with opened_beside(array.file.filename, source.file, array.where) as file:
            values = _values(array, file, source, wanted)
    out[tuple(targets)] = values.reshape([len(positions) for positions in wanted])


def _values(array: Stored, file: h5py.File, source: Source, wanted: list[range]) -> np.ndarray:
    found = member(file, "/" + source.name.lstrip("/"))
    dtype = dtype_of(found)
    where = f"{array.where} ({source.file}: {source.name})"
    if dtype is None or dtype.kind not in "fiub" or found.shape is None:
        raise fail(where, "a dataset of numbers", type(found).__name__, _REMEDY)
    stored = type(array)(found, where, array.depth + 1)
    axes = source.source or tuple(range(length) for length in stored.shape)
    # A frame may be a dataset of its own: axes of one number come and go.
    long = [positions for positions, axis in zip(wanted, source.target) if len(axis) > 1]
    if [len(axis) for axis in axes if len(axis) > 1] != [len(a) for a in source.target if len(a) > 1]:
        shapes = tuple(len(axis) for axis in source.target), tuple(len(axis) for axis in axes)
        raise fail(where, f"numbers of shape {shapes[0]}", f"{shapes[1]}", _REMEDY)
    if any(axis and axis[-1] >= length for axis, length in zip(axes, stored.shape)):
        raise fail(where, "numbers that the dataset has", "more", _REMEDY)
    order = iter(long)
    parts = [axis if len(axis) <= 1 else axis[(at := next(order)).start : at.stop] for axis in axes]
    return stored[tuple(slice(axis.start, axis[-1] + 1, axis.step) for axis in parts)]
