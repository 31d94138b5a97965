"""Reading HDF5 files that may be damaged, truncated or something else altogether.

Everything is looked up link by link: nothing outside the file is opened, and no size is believed before it is
compared with what the file stores.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail, visible
from tomo_polysplat.files import existing_file, require_plausible_size
from tomo_polysplat.json_text import parse_json
from tomo_polysplat.scan.hdf5_heaps import require_sound_heaps

if TYPE_CHECKING:
    import h5py

    from tomo_polysplat.physics.spectrum import Spectrum

__all__ = [
    *("find_array", "find_group", "number_attribute", "opened", "read_attribute", "read_json"),
    *("read_numbers", "read_spectrum", "read_text", "text_attribute", "write_spectrum"),
]

_MOST_LINKS = 16
_LARGEST_ATTRIBUTE = 2**16
_ADDRESS_BYTES = 8
# What h5py raises for files that HDF5 cannot make sense of, at any time while they are read.
_BROKEN = (OSError, RuntimeError, KeyError, UnicodeDecodeError)
_OUTSIDE = "copy the data into one file: h5repack does, and so does h5py"


@contextmanager
def opened(path: str | Path) -> Iterator[h5py.File]:
    """The file open for reading; what HDF5 reports as broken becomes one clear ValueError."""
    import h5py

    file = existing_file(path)
    require_sound_heaps(file)
    try:
        with h5py.File(file, "r") as handle:
            yield handle
    except _BROKEN as error:
        if not _of_h5py(error):
            raise
        remedy = (
            "it is not HDF5, is truncated, or needs a compression plugin (python -m pip install hdf5plugin)"
        )
        raise fail("path", "a readable HDF5 file", f"{file} ({error})", remedy) from error


def _of_h5py(error: BaseException) -> bool:
    """Whether an exception was raised by h5py, and not by what is done with what it read."""
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    return last is not None and str(last.tb_frame.f_globals.get("__name__", "")).startswith("h5py")


def _member(group: h5py.Group, path: str, links: int = _MOST_LINKS) -> Any:
    """The object at a path below a group, or None.

    Raises
    ------
    ValueError
        For a link out of the file, or one that leads round in circles.
    """
    import h5py

    here: Any = group.file if path.startswith("/") else group
    for part in filter(None, path.split("/")):
        name = part.encode("utf-8", "surrogateescape")
        # Asked of the link itself: h5py's own look-ups follow it first, to whatever file it names.
        if not isinstance(here, h5py.Group) or not here.id.links.exists(name):
            return None
        kind = here.id.links.get_info(name).type
        if kind == h5py.h5l.TYPE_SOFT:
            if not links:
                raise fail(f"{here.name}/{part}", f"at most {_MOST_LINKS} links to the data", "more")
            target = here.id.links.get_val(name).decode("utf-8", "surrogateescape")
            here = _member(here, target, links - 1)
        elif kind == h5py.h5l.TYPE_HARD:
            here = here[part]
        else:
            raise fail(f"{here.name}/{part}", "data in the file", "a link to another file", _OUTSIDE)
    return here


def find_group(group: h5py.Group, path: str) -> h5py.Group | None:
    """The group at a path, or None.

    Raises
    ------
    ValueError
        If something else than a group is there.
    """
    import h5py

    found = _member(group, path)
    if found is not None and not isinstance(found, h5py.Group):
        raise fail(f"{group.name}/{path}", "a group", _described(found))
    return found


def find_array(group: h5py.Group, name: str) -> h5py.Dataset | None:
    """The dataset called `name`, or None; its type and size are checked before anything is read.

    Raises
    ------
    ValueError
        If it holds no numbers, lies outside the file, or declares more data than the file stores.
    MemoryError
        If it is too large for the free memory.
    """
    dataset = _member(group, name)
    if dataset is None:
        return None
    where = f"{group.name}/{name}"
    dtype = _type_of(dataset)
    if dtype is None or dtype.kind not in "fiub" or dataset.shape is None:
        raise fail(where, "a dataset of numbers", _described(dataset))
    if dataset.is_virtual or dataset.external:
        raise fail(where, "data in the file", "a dataset that only refers to other files", _OUTSIDE)
    _require_stored(where, dataset, math.prod(dataset.shape) * dtype.itemsize)
    if dataset.chunks:
        _require_stored(where, dataset, math.prod(dataset.chunks) * dtype.itemsize)
        _require_chunks(where, dataset)
    return dataset


def _require_chunks(where: str, dataset: h5py.Dataset) -> None:
    """Refuse more chunks than the file can have addresses of: each would be looked for."""
    chunks = math.prod(-(-length // size) for length, size in zip(dataset.shape, dataset.chunks))
    most = Path(dataset.file.filename).stat().st_size // _ADDRESS_BYTES
    if chunks > max(most, 1):
        raise fail(where, f"at most {most} chunks in a file of this size", f"{chunks}", "damaged file")


def _described(item: Any) -> str:
    """What a file has where numbers were expected; h5py's own repr fails on types that a file has made up."""
    return f"{type(item).__name__} of type {_type_of(item)} and shape {getattr(item, 'shape', None)}"


def _type_of(dataset: Any) -> np.dtype | None:
    """NumPy's type of a dataset; None for anything else and for types that NumPy does not have."""
    import h5py

    if not isinstance(dataset, h5py.Dataset):
        return None
    try:
        return dataset.dtype
    except (TypeError, ValueError):
        return None


def _require_stored(where: str, dataset: h5py.Dataset, declared: int) -> None:
    file_size = Path(dataset.file.filename).stat().st_size
    require_plausible_size(where, declared, min(dataset.id.get_storage_size(), file_size))


def read_numbers(group: h5py.Group, name: str, shape: tuple[int, ...] | None = None) -> np.ndarray:
    """A whole dataset that must be there, of an exact `shape` when one is given."""
    dataset = find_array(group, name)
    if dataset is None:
        raise fail("path", f"a dataset {name} in {group.name}", f"none in {group.file.filename}")
    if shape is not None and tuple(dataset.shape) != tuple(shape):
        raise fail(f"{group.name}/{name}", f"shape {tuple(shape)}", f"{tuple(dataset.shape)}")
    return dataset[()]


def read_text(group: h5py.Group, name: str, default: str = "") -> str:
    """A string dataset (also one of a single element, as Data Exchange writes them)."""
    import h5py

    dataset = _member(group, name)
    dtype = _type_of(dataset)
    if dtype is None or h5py.check_string_dtype(dtype) is None or dataset.size != 1:
        return default
    _require_stored(f"{group.name}/{name}", dataset, dtype.itemsize)
    return _text(np.asarray(dataset[()]).reshape(-1)[0])


def _text(value: Any) -> str:
    return visible(value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value))


def read_attribute(item: h5py.HLObject, name: str) -> Any:
    """An attribute, or None.

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
        value = item.attrs[name] if size <= _LARGEST_ATTRIBUTE else None
    except (TypeError, ValueError) as error:
        raise fail(f"attribute '{name}' of {item.name}", "a number or a text", str(error)) from error
    if value is None:
        raise fail(f"attribute '{name}' of {item.name}", "a number or a text", f"{size} bytes")
    return value


def text_attribute(item: h5py.HLObject, name: str) -> str | None:
    """An attribute that is one text; None for anything else."""
    value = read_attribute(item, name)
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    return _text(value) if isinstance(value, (str, bytes)) else None


def number_attribute(item: h5py.HLObject, name: str) -> float | None:
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
    return parse_json(text, f"{group.name}/{name}") if text else default


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
    return Spectrum(read_numbers(lines, "energies"), read_numbers(lines, "weights"), label)
