"""Write HDF5 files so that a full disk is an error and not the end of the process.

HDF5 keeps parts of a file in memory until it is closed. If they cannot be written then, it goes on with memory that is
half freed, and the process may die. So HDF5 writes to a file object here that hides errors from it and keeps the first
one for later. The room for the arrays is taken before HDF5 begins.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.files import replacing
from tomo_polysplat.parallel import of_parts

if TYPE_CHECKING:
    import h5py

__all__ = ["new_hdf5"]

# A disk or a quota that is full, or a limit on the size of files. Others say that room cannot be taken ahead.
_FULL = (errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC))
# Bytes after which the system is asked to begin with writing to the disk, and of a block that is not written where it
# is all zeros, as a third to two thirds of the curves of dense matter are.
_PIECE, _BLOCK = 1 << 26, 1 << 16


@contextmanager
def new_hdf5(path: str | os.PathLike, *, overwrite: bool, needed_bytes: int) -> Iterator[h5py.File]:
    """An open HDF5 file that becomes `path` when the block ends without an error and all of it is on the disk.

    Parameters
    ----------
    path, overwrite
        See :func:`tomo_polysplat.files.replacing`, whose errors are raised too.
    needed_bytes : int
        Bytes of the arrays. Their room is taken first.

    Raises
    ------
    OSError
        If the file could not be written; the old one is as it was.
    """
    import h5py

    with (
        replacing(path, overwrite=overwrite, needed_bytes=needed_bytes) as temporary,
        open(temporary, "r+b", buffering=0) as file,
    ):
        _take_room(file.fileno(), needed_bytes)
        patient = _PatientFile(file.fileno())
        try:
            with h5py.File(patient, "w", driver="fileobj") as handle:
                yield handle
        except Exception as error:
            raise patient.error or error from error
        patient.finish()


def _take_room(file: int, needed_bytes: int) -> None:
    if not needed_bytes or not hasattr(os, "posix_fallocate"):
        return
    try:
        os.posix_fallocate(file, 0, needed_bytes)
    except OSError as error:
        if error.errno in _FULL:
            raise _too_full(error, needed_bytes) from error


def _too_full(error: OSError, size: int) -> Exception:
    remedy = "free some space or choose another folder"
    return fail("path", f"room for {size / 2**20:,.1f} MiB", error.strerror, remedy, OSError)


class _PatientFile:
    """A file object for HDF5. After a failed write it ignores further writes, and `finish` raises the first error."""

    def __init__(self, file: int) -> None:
        self.error: Exception | None = None
        self._file, self._at, self._end = file, 0, 0
        # Behind this nothing was ever written; the end may have moved back from there.
        self._touched = 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._end}[whence]
        self._at = start + offset
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        got = os.pread(self._file, len(view), self._at)
        view[: len(got)] = got
        # HDF5 takes fewer bytes for an error, so zeros stand for what is not written yet.
        view[len(got) :] = bytes(len(view) - len(got))
        self._at += len(view)
        return len(view)

    def read(self, size: int) -> bytes:
        """Needed because h5py recognises a file object by it; h5py reads with `readinto`."""
        buffer = bytearray(size)
        self.readinto(buffer)
        return bytes(buffer)

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        try:
            for first, last in _lit(view) if self._at >= self._touched else [(0, len(view))]:
                self._put(view[first:last], self._at + first)
        except OSError as error:
            self.error = _too_full(error, self._at + len(view)) if error.errno in _FULL else error
        self._at += len(view)
        self._end, self._touched = max(self._end, self._at), max(self._touched, self._at)
        return len(view)

    def _put(self, view: memoryview, at: int) -> None:
        """Write some bytes; the disk goes on with a piece of them while the next is handed over."""
        for first in range(0, len(view), _PIECE):
            piece, done = view[first : first + _PIECE], 0
            while self.error is None and done < len(piece):
                done += os.pwrite(self._file, piece[done:], at + first + done)
            if len(piece) >= _BLOCK and hasattr(os, "posix_fadvise"):
                with suppress(OSError):
                    os.posix_fadvise(self._file, at + first, len(piece), os.POSIX_FADV_DONTNEED)

    def truncate(self, size: int | None = None) -> int:
        self._end = self._at if size is None else size
        return self._end

    def flush(self) -> None:
        """Nothing is buffered here."""

    def finish(self) -> None:
        """Cut off the room that was not needed."""
        if self.error is not None:
            raise self.error
        os.ftruncate(self._file, self._end)


def _lit(view: memoryview) -> list[tuple[int, int]]:
    """Where bytes are not all zeros, the first and the one behind the last, by whole blocks."""
    whole = len(view) // _BLOCK
    if not whole:
        return [(0, len(view))] if len(view) else []
    blocks = np.frombuffer(view[: whole * _BLOCK], np.uint32).reshape(whole, _BLOCK // 4)
    # One at either end, so that what is lit begins and ends; what is left over behind the blocks counts as lit.
    lit = np.zeros(whole + 3, bool)
    lit[1 : whole + 1] = np.concatenate([lit[:0], *of_parts(lambda some: some.max(axis=1) > 0, blocks)])
    lit[whole + 1] = len(view) > whole * _BLOCK
    ends = np.flatnonzero(lit[1:] != lit[:-1]) * _BLOCK
    return [(first, min(last, len(view))) for first, last in ends.reshape(-1, 2).tolist()]
