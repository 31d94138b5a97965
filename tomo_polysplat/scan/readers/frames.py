"""Stacks of pictures that are read one at a time."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.files import existing_file, require_plausible_size
from tomo_polysplat.scan.hdf5_array import StoredArray
from tomo_polysplat.scan.hdf5_links import moved

__all__ = ["OTHER_PICTURE", "ArrayFrames", "Frames", "Hdf5Array", "Hdf5Frames", "TiffFrames"]

# What to do about a picture of another size among those of a scan.
OTHER_PICTURE = (
    "move it elsewhere if it is none of the scan's, else copy it again; or name a pattern (projections)"
)
# Set while this module reads: tifffile logs what it raises, and more, and a failure is told once.
_READING = ContextVar("reading", default=False)


def _of_others(_: logging.LogRecord) -> bool:
    return not _READING.get()


logging.getLogger("tifffile").addFilter(_of_others)


class Frames(Protocol):
    """Pictures of one size."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """``(pictures, rows, columns)``."""

    @property
    def dtype(self) -> np.dtype:
        """Of the numbers as they are stored."""

    def read(self, index: int, rows: slice, columns: slice) -> np.ndarray:
        """Part of one picture as it is stored."""


class ArrayFrames:
    """Pictures of an array, which may be a memory map or a dataset of an open file, (pictures, rows, columns)."""

    def __init__(self, array: Any, chosen: np.ndarray | None = None) -> None:
        if array.ndim != 3 or 0 in array.shape or array.dtype.kind not in "fiu":
            got = f"{array.dtype} of shape {tuple(array.shape)}"
            raise fail("path", "pictures of numbers, (pictures, rows, columns)", got)
        self._array = array
        self._chosen = np.arange(len(array)) if chosen is None else np.asarray(chosen)
        self.shape = (len(self._chosen), int(array.shape[1]), int(array.shape[2]))
        self.dtype = np.dtype(array.dtype)

    def read(self, index: int, rows: slice, columns: slice) -> np.ndarray:
        """Part of one picture."""
        return np.asarray(self._array[int(self._chosen[index]), rows, columns])


class Hdf5Array:
    """A dataset of an HDF5 file that has been looked through already; the file is opened when it is asked for.

    Parameters
    ----------
    found : StoredArray
        It, in a file that is open now. A link may have led to another file than the one of the scan.

    Raises
    ------
    ValueError
        If it is put together from files that are not there; HDF5 itself would give zeros for them.
    """

    def __init__(self, found: StoredArray) -> None:
        self._path, self._name = Path(found.file.filename), found.name
        self._array: Any = None
        self._moved = any(
            moved(found.file.filename, other, found.where) for other in sorted(found.other_files)
        )

    def opened(self) -> Any:
        """The dataset itself."""
        if self._array is None:
            import h5py

            # Closed with the last reference to its dataset.
            self._array = h5py.File(self._path, "r")[self._name]
            if self._moved:
                self._array = StoredArray(self._array, self._name)
        return self._array

    def read(self, where: tuple[Any, ...]) -> np.ndarray:
        """Part of it."""
        try:
            return np.asarray(self.opened()[where])
        except (OSError, RuntimeError) as error:
            remedy = "it is damaged, or needs a compression plugin (python -m pip install hdf5plugin)"
            raise fail("path", "a readable HDF5 file", f"{self._path} ({error})", remedy) from error


class Hdf5Frames:
    """Some pictures of a dataset (pictures, rows, columns) of an HDF5 file, which is opened when they are asked for.

    Parameters
    ----------
    found : StoredArray
        The dataset, in a file that is open now.
    chosen : array of int
    """

    def __init__(self, found: StoredArray, chosen: np.ndarray) -> None:
        self._array, self._chosen = Hdf5Array(found), chosen
        frames = ArrayFrames(self._array.opened(), chosen)
        self.shape, self.dtype = frames.shape, frames.dtype

    def read(self, index: int, rows: slice, columns: slice) -> np.ndarray:
        """Part of one picture."""
        return self._array.read((int(self._chosen[index]), rows, columns))


class TiffFrames:
    """Pictures of TIFF files: one in each of several files, or all in one.

    Raises
    ------
    ValueError
        For files that are no TIFFs of one channel, and pictures of different sizes.
    """

    def __init__(self, files: Iterable[Path]) -> None:
        self._files = [existing_file(file) for file in files]
        if not self._files:
            raise fail("path", "TIFF files", "none")
        first = self._files[0]
        with _page(first, 0) as page:
            pages = _count(first, page)
            self.dtype = np.dtype(page.dtype)
            rows, columns = page.shape
        if len(self._files) > 1 and pages > 1:
            raise fail("path", "one picture in each of several TIFF files", f"{pages} pictures in {first}")
        self.shape = (max(pages, len(self._files)), rows, columns)

    def read(self, index: int, rows: slice, columns: slice) -> np.ndarray:
        """Part of one picture."""
        file, number = (self._files[0], index) if len(self._files) == 1 else (self._files[index], 0)
        with _page(file, number) as page:
            if page.shape != self.shape[1:] or np.dtype(page.dtype) != self.dtype:
                got = f"{page.dtype} of {page.shape} in {file}"
                expected = f"{self.dtype} of {self.shape[1:]} as in {self._files[0].name}"
                raise fail("path", expected, got, OTHER_PICTURE)
            try:
                return page.asarray()[rows, columns]
            except Exception as error:  # its decoders raise whatever they meet
                raise _unreadable(file, error) from error


def _count(file: Path, page: Any) -> int:
    """Pictures of the file of a page."""
    try:
        return len(page.parent.pages)
    except Exception as error:  # its parser raises whatever it meets
        raise _unreadable(file, error) from error


@contextmanager
def _page(file: Path, number: int) -> Iterator[Any]:
    """One picture of a TIFF file, which is open meanwhile."""
    import tifffile

    before = _READING.set(True)
    try:
        try:
            tiff = tifffile.TiffFile(file)
        except Exception as error:  # its parser raises whatever it meets
            raise _unreadable(file, error) from error
        with tiff:
            try:
                page = tiff.pages[number]
                size = int(page.nbytes)  # which takes its shape and type apart
            except Exception as error:
                raise _unreadable(file, error) from error
            _require_picture(file, page, size)
            yield page
    finally:
        _READING.reset(before)


def _unreadable(file: Path, error: Exception) -> Exception:
    remedy = "pip install imagecodecs" if "imagecodecs" in str(error) else "copy or write the file again"
    return fail("path", "a readable TIFF file", f"{file} ({str(error)[:120]})", remedy)


def _require_picture(file: Path, page: Any, size: int) -> None:
    """Refuse colours, and a header that promises more than the file can hold."""
    if len(page.shape) != 2 or 0 in page.shape or page.dtype is None or page.dtype.kind not in "fiu":
        got = f"{page.dtype} of shape {page.shape} in {file}"
        raise fail("path", "TIFF pictures of one channel, (rows, columns)", got, "save them as grey values")
    require_plausible_size(file.name, size, file.stat().st_size)
