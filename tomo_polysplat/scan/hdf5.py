"""Reading HDF5 files that may be damaged, truncated or something else altogether."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.files import existing_file, require_plausible_size

if TYPE_CHECKING:
    import h5py

    from tomo_polysplat.physics.spectrum import Spectrum

__all__ = [
    "find_array",
    "opened",
    "read_json",
    "read_numbers",
    "read_spectrum",
    "read_text",
    "write_spectrum",
]


@contextmanager
def opened(path: str | Path) -> Iterator[h5py.File]:
    """The file open for reading; what HDF5 reports as broken becomes one clear ValueError."""
    import h5py

    file = existing_file(path)
    try:
        with h5py.File(file, "r") as handle:
            yield handle
    except OSError as error:
        remedy = (
            "it is not HDF5, is truncated, or needs a compression plugin (python -m pip install hdf5plugin)"
        )
        raise fail("path", "a readable HDF5 file", f"{file} ({error})", remedy) from error


def find_array(group: h5py.Group, name: str) -> h5py.Dataset | None:
    """The dataset called `name`, or None; its type and size are checked before anything is read.

    Raises
    ------
    ValueError
        If it holds no numbers, or declares more data than the file stores.
    MemoryError
        If it is larger than the free memory.
    """
    import h5py

    dataset = group.get(name)
    if dataset is None:
        return None
    if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "fiub" or dataset.shape is None:
        raise fail(f"{group.name}/{name}", "a dataset of numbers", repr(dataset))
    declared = int(np.prod(dataset.shape, dtype=object)) * dataset.dtype.itemsize
    stored = declared if dataset.is_virtual or dataset.external else dataset.id.get_storage_size()
    require_plausible_size(f"{group.name}/{name}", declared, stored)
    return dataset


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

    dataset = group.get(name)
    if (
        not isinstance(dataset, h5py.Dataset)
        or h5py.check_string_dtype(dataset.dtype) is None
        or dataset.size != 1
    ):
        return default
    value = np.asarray(dataset[()]).reshape(-1)[0]
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def read_json(group: h5py.Group, name: str, default: Any) -> Any:
    """What a string dataset holds as JSON."""
    text = read_text(group, name)
    try:
        return json.loads(text) if text else default
    except ValueError as error:
        raise fail(f"{group.name}/{name}", "JSON text", f"{text[:40]!r}") from error


def write_spectrum(group: h5py.Group, spectrum: Spectrum | None) -> None:
    """Keep a spectrum, if there is one, in a group ``spectrum``: ``energies`` (keV) and ``weights``."""
    if spectrum is not None:
        lines = group.create_group("spectrum")
        lines["energies"], lines["weights"] = spectrum.energies, spectrum.weights
        lines.attrs["label"] = spectrum.label


def read_spectrum(group: h5py.Group) -> Spectrum | None:
    """What :func:`write_spectrum` kept, or None."""
    from tomo_polysplat.physics.spectrum import Spectrum

    lines = group.get("spectrum")
    if lines is None:
        return None
    label = str(lines.attrs.get("label", "measured spectrum"))
    return Spectrum(read_numbers(lines, "energies"), read_numbers(lines, "weights"), label)
