"""Views that stay in a Data Exchange file: it is opened anew each time that some are read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tomo_polysplat.checks import fail
from tomo_polysplat.scan.counts import Read
from tomo_polysplat.scan.hdf5 import find_array, opened
from tomo_polysplat.scan.readers.part import Part
from tomo_polysplat.scan.stored_part import StoredPart

__all__ = ["StoredViews"]

_DATA = "exchange/data"


class StoredViews:
    """What `Counts` reads from.

    Parameters
    ----------
    path : Path
        A file whose ``/exchange/data`` (views, rows, columns) was looked at before.
    part : Part
        Of its views, rows and columns, without binning.
    """

    def __init__(self, path: Path, part: Part) -> None:
        self._path, self._part = path.resolve(), part
        self._as_it_was = _identity(self._path)

    @contextmanager
    def __call__(self) -> Iterator[Read]:
        """The function that reads a slice of the views, while the file is open.

        Raises
        ------
        ValueError
            If the file has changed since.
        """
        with opened(self._path) as file:
            data = find_array(file, _DATA)
            if data is None or _identity(self._path) != self._as_it_was:
                remedy = "load the scan again"
                raise fail("path", "the file as it was when the scan was loaded", f"{self._path}", remedy)
            yield StoredPart(data, self._part).block


def _identity(path: Path) -> tuple[int, int, int]:
    stat = path.stat()
    return stat.st_ino, stat.st_size, stat.st_mtime_ns
