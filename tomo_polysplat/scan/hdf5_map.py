"""Large arrays of an HDF5 file as a map of the file: what is not looked at is not in memory."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.scan.hdf5 import read_numbers
from tomo_polysplat.scan.hdf5_links import member

if TYPE_CHECKING:
    import h5py

__all__ = ["is_mapped", "mapped", "read_or_map"]

# Bytes of an array from which it is mapped: a smaller one is sooner read.
_LARGE = 1 << 30


def read_or_map(group: h5py.Group, name: str) -> np.ndarray:
    """A whole dataset that must be there, as `read_numbers` reads it, or mapped where it is large."""
    found = mapped(group, name)
    return read_numbers(group, name) if found is None else found


def mapped(group: h5py.Group, name: str) -> np.ndarray | None:
    """A large dataset as a map of its file, or None where it is small, or stored in another way than as plain numbers.

    What is written to the array stays in memory: the file does not change. If another program cuts the file off while
    it is mapped, the system may end this process; a file that is replaced, as `Result.save` does, stays whole.
    """
    import h5py

    dataset: Any = member(group, name)
    if not isinstance(dataset, h5py.Dataset) or dataset.shape is None or dataset.is_virtual:
        return None
    if dataset.chunks or dataset.external:
        return None
    plain = dataset.id.get_type().equal(h5py.h5t.NATIVE_FLOAT)
    size = 4 * int(np.prod(dataset.shape, dtype=object))
    place, path = dataset.id.get_offset(), Path(dataset.file.filename)
    if not plain or size < _LARGE or place is None or place % 4 or place + size > path.stat().st_size:
        return None
    return np.asarray(np.memmap(path, np.float32, "c", place, dataset.shape))


def is_mapped(array: np.ndarray) -> bool:
    """Whether an array is a map of a file, or a part of one."""
    base: Any = array
    while base is not None and not isinstance(base, np.memmap):
        base = getattr(base, "base", None)
    return base is not None
