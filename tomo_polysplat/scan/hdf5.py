"""Reading HDF5 files that may be damaged, truncated or something else altogether.

Everything is looked up link by link (`hdf5_links`): nothing outside the folder of the file is opened. No size is
believed before it is compared with what the file stores (`hdf5_array`), and texts are read without HDF5
(`hdf5_heaps`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail, visible
from tomo_polysplat.files import existing_file
from tomo_polysplat.json_text import parse_json
from tomo_polysplat.scan.hdf5_array import StoredArray
from tomo_polysplat.scan.hdf5_child import text_apart
from tomo_polysplat.scan.hdf5_chunks import chunk_bytes
from tomo_polysplat.scan.hdf5_headers import attribute_bytes, layout
from tomo_polysplat.scan.hdf5_heaps import referred_text, require_plain_start
from tomo_polysplat.scan.hdf5_links import dtype_of, held_files, member

if TYPE_CHECKING:
    import h5py

    from tomo_polysplat.physics.spectrum import Spectrum

__all__ = [
    *("find_array", "find_group", "is_in_radians", "number_attribute", "opened", "read_attribute"),
    *("read_json", "read_numbers", "read_spectrum", "read_text", "text_attribute", "write_spectrum"),
]

_LARGEST_ATTRIBUTE = 2**16
_MOST_ENERGIES = 1_000_000
# Of a reference to a text of any length.
_REFERENCE_BYTES = 16
# What h5py raises for files that HDF5 cannot make sense of, at any time while they are read.
_BROKEN = (OSError, RuntimeError, KeyError, UnicodeDecodeError)


@contextmanager
def opened(path: str | Path) -> Iterator[h5py.File]:
    """The file open for reading; what HDF5 reports as broken becomes one clear ValueError."""
    import h5py

    file = existing_file(path)
    with open(file, "rb") as stream:
        require_plain_start(stream, str(file))
    try:
        with held_files(), h5py.File(file, "r") as handle:
            yield handle
    except _BROKEN as error:
        if not _of_h5py(error):
            raise
        remedy = (
            "it is not HDF5, is truncated, or needs a filter (python -m pip install 'tomo-polysplat[hdf5]')"
        )
        raise fail("path", "a readable HDF5 file", f"{file} ({error})", remedy) from error


def _of_h5py(error: BaseException) -> bool:
    """Whether an exception was raised by h5py, and not by what is done with what it read."""
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    return last is not None and str(last.tb_frame.f_globals.get("__name__", "")).startswith("h5py")


def find_group(group: h5py.Group, path: str) -> h5py.Group | None:
    """The group at a path, or None.

    Raises
    ------
    ValueError
        If something else than a group is there.
    """
    import h5py

    found = member(group, path)
    if found is not None and not isinstance(found, h5py.Group):
        raise fail(_where(group, path), "a group", _described(found))
    return found


def find_array(group: h5py.Group, name: str) -> StoredArray | None:
    """The dataset called `name`, or None; its type and size are checked before anything is read.

    Raises
    ------
    ValueError
        If it holds no numbers, lies outside the folder of the file, or declares more data than the file stores.
    MemoryError
        If it is too large for the free memory.
    """
    dataset = member(group, name)
    if dataset is None:
        return None
    where = _where(group, name)
    dtype = dtype_of(dataset)
    if dtype is None or dtype.kind not in "fiub" or dataset.shape is None:
        raise fail(where, "a dataset of numbers", _described(dataset))
    return StoredArray(dataset, where)


def _where(group: h5py.Group, name: str) -> str:
    """What errors call a member of a group."""
    return f"{group.name.rstrip('/')}/{name}"


def _described(item: Any) -> str:
    """What a file has where numbers were expected; h5py's own repr fails on types that a file has made up."""
    return f"{type(item).__name__} of type {dtype_of(item)} and shape {getattr(item, 'shape', None)}"


def read_numbers(
    group: h5py.Group, name: str, shape: tuple[int, ...] | None = None, *, most: int | None = None
) -> np.ndarray:
    """A whole dataset that must be there.

    Parameters
    ----------
    shape : tuple of int, or None
        What it must have.
    most : int or None
        Numbers that it may have; more are refused before any is read.
    """
    dataset = find_array(group, name)
    if dataset is None:
        raise fail("path", f"a dataset {name} in {group.name}", f"none in {group.file.filename}")
    if shape is not None and dataset.shape != tuple(shape):
        raise fail(_where(group, name), f"shape {tuple(shape)}", f"{dataset.shape}")
    if most is not None and dataset.size > most:
        raise fail(_where(group, name), f"at most {most} numbers", f"shape {dataset.shape}")
    return dataset[()]


def read_text(group: h5py.Group, name: str, default: str = "") -> str:
    """A string dataset (also one of a single element, as Data Exchange writes them)."""
    import h5py

    dataset = member(group, name)
    dtype = dtype_of(dataset)
    about = None if dtype is None else h5py.check_string_dtype(dtype)
    if about is None or dataset.size != 1:
        return default
    where = _where(group, name)
    if about.length is not None:
        return _text(StoredArray(dataset, where)[()].reshape(-1)[0])
    reference = _stored_bytes(dataset, where)
    if reference is None:
        return default
    with open(dataset.file.filename, "rb") as stream:
        return _text(referred_text(stream, where, reference))


def _stored_bytes(dataset: h5py.Dataset, where: str) -> bytes | None:
    """The reference to the one text of a dataset as it is stored; None where nothing was written."""
    import h5py

    if dataset.chunks:
        return chunk_bytes(dataset, where, _REFERENCE_BYTES)
    place = dataset.id.get_offset()
    with open(dataset.file.filename, "rb") as stream:
        if place is not None:
            stream.seek(place)
            return stream.read(_REFERENCE_BYTES)
        stored = layout(stream, h5py.h5o.get_info(dataset.id).addr)
        return stored.data if stored is not None and stored.data else None


def _text(value: Any) -> str:
    return visible(value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value))


def read_attribute(item: h5py.HLObject | StoredArray, name: str) -> Any:
    """An attribute, or None where there is none, or several texts of any length.

    Raises
    ------
    ValueError
        If it is of a type that NumPy does not have, or large.
    """
    import h5py

    if name not in item.attrs:
        return None
    try:
        about = item.attrs.get_id(name)
        size = math.prod(about.shape or ()) * about.dtype.itemsize
        # Of what else there is, lists of a length of their own that are damaged end the process.
        if about.dtype.kind not in "fiubS" and h5py.check_string_dtype(about.dtype) is None:
            raise TypeError(f"values of type {about.dtype}")
    except (TypeError, ValueError) as error:
        raise fail(f"attribute '{name}' of {item.name}", "a number or a text", str(error)) from error
    if size > _LARGEST_ATTRIBUTE:
        raise fail(f"attribute '{name}' of {item.name}", "a number or a text", f"{size} bytes")
    return _attribute(item, name, about)


def _attribute(item: h5py.HLObject | StoredArray, name: str, about: Any) -> Any:
    """Its value; a text of any length is read without HDF5, which takes the memory that it states to need."""
    import h5py

    text = h5py.check_string_dtype(about.dtype)
    if text is None or text.length is not None or about.shape is None:
        return item.attrs[name]
    where = f"attribute '{name}' of {item.name}"
    if math.prod(about.shape) != 1:
        return None
    with open(item.file.filename, "rb") as stream:
        stored = attribute_bytes(stream, h5py.h5o.get_info(item.id).addr, name)
        if stored is not None:
            return _text(referred_text(stream, where, stored[:_REFERENCE_BYTES]))
    return text_apart(item.file.filename, item.name, name, where)


def text_attribute(item: h5py.HLObject | StoredArray, name: str) -> str | None:
    """An attribute that is one text; None for anything else."""
    value = read_attribute(item, name)
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    return _text(value) if isinstance(value, (str, bytes)) else None


def is_in_radians(angles: h5py.HLObject | StoredArray) -> bool:
    """Whether their attribute ``units`` says so; degrees are usual."""
    return (text_attribute(angles, "units") or "").lower().startswith("rad")


def number_attribute(item: h5py.HLObject | StoredArray, name: str) -> float | None:
    """An attribute that is one finite number, or None where there is none."""
    value = read_attribute(item, name)
    if value is None:
        return None
    array = np.asarray(value)
    if array.dtype.kind not in "fiub" or array.size != 1 or not np.isfinite(array).all():
        raise fail(f"attribute '{name}' of {item.name}", "one finite number", repr(value)[:100])
    return float(array.reshape(()))


def read_json(group: h5py.Group, name: str, default: Any) -> Any:
    """What a string dataset holds as JSON."""
    text = read_text(group, name)
    return parse_json(text, _where(group, name)) if text else default


def write_spectrum(group: h5py.Group, spectrum: Spectrum | None) -> None:
    """Keep a spectrum, if there is one, in a group ``spectrum``: ``energies`` (keV) and ``weights``."""
    if spectrum is not None:
        lines = group.create_group("spectrum")
        lines["energies"], lines["weights"] = spectrum.energies, spectrum.weights
        lines.attrs["label"] = spectrum.label


def read_spectrum(group: h5py.Group) -> Spectrum | None:
    """What :func:`write_spectrum` kept, or None."""
    from tomo_polysplat.physics.spectrum import Spectrum

    lines = find_group(group, "spectrum")
    if lines is None:
        return None
    label = text_attribute(lines, "label") or "measured spectrum"
    energies, weights = (read_numbers(lines, name, most=_MOST_ENERGIES) for name in ("energies", "weights"))
    return Spectrum(energies, weights, label)
