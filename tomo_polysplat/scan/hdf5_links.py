"""Looking things up in an HDF5 file, link by link.

HDF5 follows links by itself to whatever file they name, and soft links to soft links for ever. Here both are
counted, and another file is opened only if it lies in the folder of the first one or below it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.scan.hdf5_headers import layout
from tomo_polysplat.scan.hdf5_heaps import heap_object, require_plain_start

if TYPE_CHECKING:
    import h5py

__all__ = ["MOST_LINKS", "beside", "dtype_of", "held_files", "member", "moved", "opened_beside"]

MOST_LINKS = 16
# Names on the way to the data, those in the links included.
_MOST_STEPS = 1000
_MOST_FILES = 64


class _Files(ExitStack):
    number = 0


# Other files that are open as long as the first one is; None where there is no first one.
_held: ContextVar[_Files | None] = ContextVar("_held", default=None)


@contextmanager
def held_files() -> Iterator[None]:
    """Until the end, files that links lead to stay open."""
    with _Files() as stack:
        token = _held.set(stack)
        try:
            yield
        finally:
            _held.reset(token)


def member(group: h5py.Group, path: str | bytes) -> Any:
    """The object at a path below a group, or None.

    Raises
    ------
    ValueError
        For links that lead round in circles or out of the folder of the file, and for objects that HDF5 would not
        return from.
    """
    import h5py

    # h5py gives names that are no UTF-8 as bytes.
    path = os.fsdecode(path)
    here: Any = group.file if path.startswith("/") else group
    names, links, steps = _names(path), 0, 0
    while names:
        where = f"{getattr(here, 'name', '').rstrip('/')}/{names[0]}"
        part, name = names[0], names[0].encode("utf-8", "surrogateescape")
        names, steps = names[1:], steps + 1
        # Asked of the link itself: h5py's own look-ups follow it first, to whatever file it names.
        if not isinstance(here, h5py.Group) or not here.id.links.exists(name):
            return None
        about = here.id.links.get_info(name)
        if about.type == h5py.h5l.TYPE_HARD:
            _require_end(here, about.u, part)
            here = here[part]
            continue
        links += 1
        if links > MOST_LINKS or steps > _MOST_STEPS:
            raise fail(where, f"at most {MOST_LINKS} links to the data", "more")
        target = here.id.links.get_val(name)
        if about.type == h5py.h5l.TYPE_EXTERNAL:
            other, target = target
            here = _held_file(here, os.fsdecode(other), where)
        elif about.type != h5py.h5l.TYPE_SOFT:
            raise fail(where, "data, or a link to data", f"a link of type {about.type}")
        text = target.decode("utf-8", "surrogateescape")
        here = here.file if text.startswith("/") else here
        names = _names(text) + names
    return here


def _names(path: str) -> list[str]:
    """Parts of a path, and one more than may be, so that a long one is not kept whole."""
    return [part for part in path.split("/", 2 * _MOST_STEPS) if part not in ("", ".")][: _MOST_STEPS + 1]


def _require_end(group: h5py.Group, address: int, name: str) -> None:
    """Refuse a virtual dataset that HDF5 would not return from opening."""
    with open(group.file.filename, "rb") as stream:
        stored = layout(stream, address)
        if stored is not None and stored.heap is not None:
            heap_object(stream, f"{group.name}/{name}", *stored.heap)


def _held_file(group: h5py.Group, other: str, where: str) -> h5py.File:
    stack = _held.get()
    if stack is None:
        raise fail(where, "data in the file", f"a link to {other}")
    if stack.number >= _MOST_FILES:
        raise fail(where, f"links to at most {_MOST_FILES} other files", "more")
    stack.number += 1
    return stack.enter_context(opened_beside(group.file.filename, other, where))


@contextmanager
def opened_beside(main: str, other: str, where: str) -> Iterator[h5py.File]:
    """Another file that a file names, open for reading; see `beside`."""
    import h5py

    file = beside(main, other, where)
    with open(file, "rb") as stream:
        require_plain_start(stream, str(file))
    with h5py.File(file, "r") as handle:
        yield handle


def beside(main: str, other: str, where: str) -> Path:
    """The file of the name `other` in the folder of `main` or below it.

    A name that leads elsewhere is looked for in that folder without what stands before it.

    Raises
    ------
    ValueError
        If there is none, or it is a link out of the folder, a device or a pipe.
    """
    folder = Path(os.path.realpath(main)).parent
    last = other.replace("\\", "/").rsplit("/", 1)[-1]
    for name in (other, last):
        try:
            file = Path(os.path.realpath(folder / name))
            if name and file.is_relative_to(folder) and file.is_file():
                return file
        except (OSError, ValueError):
            continue
    raise fail(
        where,
        f"data in {Path(main).name} or in a file beside it",
        f"a link to {other}, which is not there or not in this folder",
        f"put {last} (the file itself, not a link) into {folder}",
    )


def moved(main: str, other: str, where: str) -> bool:
    """Whether the file of the name `other` is elsewhere than HDF5 would look for it first; see `beside`."""
    return Path(os.path.realpath(Path(os.path.realpath(main)).parent / other)) != beside(main, other, where)


def dtype_of(dataset: Any) -> np.dtype | None:
    """NumPy's type of a dataset; None for anything else and for types that NumPy does not have."""
    import h5py

    if not isinstance(dataset, h5py.Dataset):
        return None
    try:
        return dataset.dtype
    except (TypeError, ValueError):
        return None
