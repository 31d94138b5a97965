"""Which files of a folder hold scans of a kind."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from tomo_polysplat.checks import fail
from tomo_polysplat.scan.hdf5 import opened
from tomo_polysplat.scan.readers.entries import entries_of

if TYPE_CHECKING:
    import h5py

__all__ = ["hdf5_files", "the_one"]


def the_one(
    files: Sequence[Path], expected: str = "one scan in the folder", remedy: str = "name the file"
) -> Path:
    """The only one of the files that were recognised.

    Raises
    ------
    ValueError
        If there are several.
    """
    if len(files) > 1:
        raise fail("path", expected, ", ".join(file.name for file in files), remedy)
    return files[0]


def hdf5_files(path: Path, suffixes: Sequence[str], holds: Callable[[h5py.File], bool]) -> list[Path]:
    """The file, or those with such an ending in the folder, that are HDF5 and hold what is looked for."""
    inside = [path] if path.is_file() else entries_of(path)
    named = [file for file in inside if file.is_file() and (file == path or file.suffix.lower() in suffixes)]
    return [file for file in named if _is_hdf5(file) and _holds(file, holds)]


def _is_hdf5(file: Path) -> bool:
    with open(file, "rb") as stream:
        return stream.read(4) == b"\x89HDF"


def _holds(file: Path, holds: Callable[[h5py.File], bool]) -> bool:
    with opened(file) as handle:
        return holds(handle)
