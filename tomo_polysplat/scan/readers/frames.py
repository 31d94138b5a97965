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

__all__ = ["OTHER_PICTURE", "ArrayFrames", "Frames", "Hdf5Array", "Hdf5Frames", "MeanOfSums", "TiffFrames"]

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


class MeanOfSums:
    """Pictures each of which is the sum of so many."""

    def __init__(self, sums: Frames, summed: int) -> None:
        self._sums, self._summed = sums, summed
        self.shape, self.dtype = sums.shape, np.dtype(np.float32)

    def read(self, index: int, rows: slice, columns: slice) -> np.ndarray:
        """Part of the mean of the pictures of one sum."""
        return self._sums.read(index, rows, columns) / np.float32(self._summed)


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
    """Pictures of TIFF files: one in each of several files, or several in one or in each.

    A stack of more than 4 GB that ImageJ wrote has the first picture's entry alone, and the others behind it.

    Raises
    ------
    ValueError
        For files that are no TIFFs of one channel, and pictures of different sizes.
    """

    def __init__(self, files: Iterable[Path]) -> None:
        self._files = [existing_file(file) for file in files]
        if not self._files:
            raise fail("path", "TIFF files", "none")
        with _page(self._files[0], 0) as page:
            self.dtype = np.dtype(page.dtype)
            rows, columns = page.shape
            first, behind = _count(self._files[0], page), _lies_behind(page)
            stored = self.dtype.newbyteorder(page.parent.byteorder)
        # Where the first file has one picture, so have the others, which are opened when they are asked for.
        others = [1 if first == 1 else _pages(file) for file in self._files[1:]]
        self._ends = np.cumsum([first, *others])
        self._mapped = None
        if behind is not None:
            if others:
                got, remedy = f"{len(self._files)} such files", "write it as an image sequence"
                raise fail("path", "one stack of ImageJ's of more than 4 GB", got, remedy)
            self._mapped = _mapped(self._files[0], stored, behind, (first, rows, columns))
        self.shape = (int(self._ends[-1]), rows, columns)

    def read(self, index: int, rows: slice, columns: slice) -> np.ndarray:
        """Part of one picture."""
        if self._mapped is not None:
            return np.array(self._mapped[index, rows, columns])
        which = int(np.searchsorted(self._ends, index, "right"))
        file, number = self._files[which], index - (int(self._ends[which - 1]) if which else 0)
        with _page(file, number) as page:
            if page.shape != self.shape[1:] or np.dtype(page.dtype) != self.dtype:
                got = f"{page.dtype} of {page.shape} in {file}"
                expected = f"{self.dtype} of {self.shape[1:]} as in {self._files[0].name}"
                raise fail("path", expected, got, OTHER_PICTURE)
            try:
                return page.asarray()[rows, columns]
            except Exception as error:  # its decoders raise whatever they meet
                raise _unreadable(file, error) from error


def _pages(file: Path) -> int:
    with _page(file, 0) as page:
        return _count(file, page)


def _count(file: Path, page: Any) -> int:
    """Pictures of the file of a page, without small ones of them for a viewer."""
    try:
        tiff = page.parent
        if _lies_behind(page) is not None:
            return int(tiff.imagej_metadata["images"])
        pages = len(tiff.pages)
        return 1 if pages == 2 and tiff.pages[1].is_reduced else pages
    except Exception as error:  # its parser raises whatever it meets
        raise _unreadable(file, error) from error


def _lies_behind(page: Any) -> int | None:
    """First byte of a stack of ImageJ's whose pictures follow the first one without entries; None of any other."""
    tiff = page.parent
    described = (tiff.imagej_metadata or {}) if tiff.is_imagej else {}
    if len(tiff.pages) > 1 or not isinstance(described.get("images"), int) or described["images"] < 2:
        return None
    return int(page.dataoffsets[0])


def _mapped(file: Path, dtype: np.dtype, offset: int, shape: tuple[int, int, int]) -> np.ndarray:
    """The pictures of such a stack, as numbers of the file's order of bytes."""
    try:
        return np.memmap(file, dtype, "r", offset, shape)
    except ValueError as error:  # it is shorter than it says
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
