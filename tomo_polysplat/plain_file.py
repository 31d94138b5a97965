"""A file whose every write either happens or raises an error.

``numpy.ndarray.tofile``, which NumPy and tifffile use on files of the system, writes through a stream of C's and does
not look whether its last part, some kilobytes, has reached the disk: on a full one a file is cut short in silence.
It cannot be used on a file object without a number of the system, such as this one.
"""

from __future__ import annotations

import io
import os
from typing import Any

__all__ = ["PlainFile"]


class PlainFile(io.RawIOBase):
    """A new or emptied file, for writing and reading.

    Parameters
    ----------
    path : path

    Raises
    ------
    OSError
        From whichever call could not write.
    """

    def __init__(self, path: str | os.PathLike) -> None:
        self._file = open(path, "w+b", buffering=0)  # noqa: SIM115  # closed with the object

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def readinto(self, buffer: Any) -> int | None:
        return self._file.readinto(buffer)

    def truncate(self, size: int | None = None) -> int:
        return self._file.truncate(size)

    def write(self, data: Any) -> int:
        """All of the data: the system may take a part only, and says so by a number."""
        view = memoryview(data).cast("B")
        done = 0
        while done < len(view):
            done += self._file.write(view[done:]) or 0
        return len(view)

    def close(self) -> None:
        self._file.close()
        super().close()
