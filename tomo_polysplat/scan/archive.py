"""Read NumPy archives that may be damaged, truncated or other files."""

from __future__ import annotations

import io
import math
import struct
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import IO

import numpy as np

from tomo_polysplat.checks import fail, require_array, visible
from tomo_polysplat.files import existing_file, require_plausible_size

__all__ = ["archive_names", "archived_number", "archived_text", "read_archive"]

_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
# NumPy writes no other kinds; some of them may need gigabytes before they give the first byte.
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# What zipfile and zlib raise for archives that are broken, encrypted or of a later version.
_BROKEN = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, RuntimeError, UnicodeDecodeError)
_LONGEST_TEXT = 1000
# NumPy's own limit for headers that it takes apart.
_LONGEST_HEADER = 10_000
# The list of an archive's members is taken into memory whole, some ten times as large; ours have 15 members.
_LARGEST_DIRECTORY = 2**20


def read_archive(
    path: str | Path,
    names: Iterable[str],
    most: Mapping[str, int] | None = None,
    *,
    compressed: bool = True,
) -> dict[str, np.ndarray]:
    """Read the arrays called `names` that a NumPy archive has.

    `most` limits how many numbers some of them may have; the header alone is enough to refuse more. Without
    `compressed` the arrays need no more memory than the file has bytes.

    Nothing is unpickled, and each header is compared with what is stored before memory is taken.

    Raises
    ------
    ValueError
        If the file is not such an archive, is truncated, or a header does not fit its data.
    MemoryError
        If an array is too large for the free memory.
    """
    file = existing_file(path)
    size = file.stat().st_size
    try:
        with _Listed(io.FileIO(file)) as stream, zipfile.ZipFile(stream) as archive:
            stream.listed = True
            members = {info.filename: info for info in archive.infolist()}
            chosen = [name for name in names if f"{name}.npy" in members]
            limits = most or {}
            kinds = _COMPRESSIONS if compressed else (zipfile.ZIP_STORED,)
            return {
                name: _read_member(archive, members[f"{name}.npy"], size, limits.get(name), kinds)
                for name in chosen
            }
    except _BROKEN as error:
        raise fail(
            "path", "a readable .npz archive", f"{file} ({error})", "copy or write the file again"
        ) from error


def archive_names(path: Path) -> set[str]:
    """Names of the arrays of a NumPy archive; none of a file that is no archive, or a broken one."""
    try:
        with _Listed(io.FileIO(path)) as stream, zipfile.ZipFile(stream) as archive:
            stream.listed = True
            return {name[:-4] for name in archive.namelist() if name.endswith(".npy")}
    except _BROKEN:
        return set()


class _Listed(io.BufferedReader):
    """A file of which `zipfile` reads no longer list of members than ours may be."""

    listed = False

    def read(self, size: int | None = -1, /) -> bytes:
        if not self.listed and size is not None and size > _LARGEST_DIRECTORY:
            raise zipfile.BadZipFile(f"its list of members has {size} bytes, at most {_LARGEST_DIRECTORY}")
        return super().read(size)


def _read_member(
    archive: zipfile.ZipFile,
    info: zipfile.ZipInfo,
    file_size: int,
    most: int | None,
    kinds: tuple[int, ...],
) -> np.ndarray:
    if info.compress_type not in kinds:
        expected = "a stored or deflated array" if len(kinds) > 1 else "a stored array"
        raise fail(info.filename, expected, f"compression type {info.compress_type}")
    with archive.open(info) as stream:
        shape, dtype = _header(stream, info)
    if most is not None and math.prod(shape) > most:
        raise fail(info.filename, f"at most {most} numbers", f"shape {shape}"[:200], "damaged file")
    declared = math.prod(shape) * dtype.itemsize
    if declared > info.file_size:
        raise fail(
            info.filename, f"{declared} bytes as its header declares", f"{info.file_size}", "damaged file"
        )
    require_plausible_size(info.filename, declared, min(info.compress_size, file_size))
    with archive.open(info) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)


def _header(stream: IO[bytes], info: zipfile.ZipInfo) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type that an array's header declares."""
    try:
        version = np.lib.format.read_magic(stream)
        if version not in _HEADERS:
            raise ValueError(f"format {version}")
        # Its length first: NumPy reads the whole of a header before it asks whether that is too long.
        layout = "<H" if version == (1, 0) else "<I"
        length = stream.read(struct.calcsize(layout))
        (size,) = struct.unpack(layout, length)
        if size > _LONGEST_HEADER:
            raise ValueError(f"{size} bytes of it")
        shape, _, dtype = _HEADERS[version](io.BytesIO(length + stream.read(size)))
    except _BROKEN:
        raise
    except Exception as error:  # the text of a header goes through Python's parser, which may raise anything
        raise fail(info.filename, "the header of a NumPy array", str(error)[:200], "damaged file") from error
    if dtype.hasobject:
        raise fail(info.filename, "an array of numbers", "pickled objects, which are never loaded")
    if dtype.kind not in "fiubU" or min(shape, default=0) < 0 or (dtype.itemsize == 0 and shape):
        raise fail(info.filename, "an array of numbers", f"{dtype} of shape {shape}"[:200])
    return shape, dtype


def archived_number(arrays: dict[str, np.ndarray], *names: str) -> float | None:
    """The first of the named numbers that is there."""
    for name in names:
        if name in arrays:
            array = require_array(name, arrays[name])
            if array.size != 1 or not np.isfinite(array).all():
                raise fail(name, "one finite number", f"shape {array.shape}")
            return float(array.reshape(()))
    return None


def archived_text(arrays: dict[str, np.ndarray], name: str) -> str | None:
    """A short text, where it is there."""
    if name not in arrays:
        return None
    array = arrays[name]
    if array.dtype.kind != "U" or array.size != 1 or array.dtype.itemsize > 4 * _LONGEST_TEXT:
        raise fail(name, "a short text", f"{array.dtype} of shape {array.shape}")
    try:
        return visible(array.reshape(-1)[0])
    except ValueError as error:
        raise fail(name, "a text", "characters that do not exist") from error
