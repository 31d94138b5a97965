"""Compound files (OLE2), a small file system in one file: streams of numbers and texts by their names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.files import existing_file

__all__ = ["CompoundFile", "is_compound"]

_MAGIC = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"
# Of a text, or of the numbers of all views, in bytes.
_MOST_BYTES = 1 << 24


def is_compound(path: Path) -> bool:
    """Whether the file begins as a compound file does."""
    with open(path, "rb") as stream:
        return stream.read(len(_MAGIC)) == _MAGIC


class CompoundFile:
    """A compound file that is read stream by stream; names of streams do not depend on case.

    Parameters
    ----------
    path : Path

    Raises
    ------
    ImportError
        Without olefile.
    ValueError
        If the file is none, or damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = existing_file(path)
        try:
            import olefile
        except ImportError as error:
            remedy = "python -m pip install 'tomo-polysplat[scanners]'"
            raise fail(
                "path", "olefile, which reads .txrm and .xrm files", "none", remedy, ImportError
            ) from error
        self._size = self.path.stat().st_size
        try:
            # Without a name it leaves the file open, and closes it with the last reference.
            self._file = olefile.OleFileIO(str(self.path))
        except Exception as error:  # its parser raises whatever it meets
            raise self._unreadable(error) from error

    def __del__(self) -> None:
        file = getattr(self, "_file", None)
        if file is not None:
            file.close()

    def __contains__(self, name: str) -> bool:
        """Whether there is a stream of that name, or a folder of streams."""
        return self.size(name) is not None or self._is_folder(name)

    def _is_folder(self, name: str) -> bool:
        try:
            return bool(self._file.get_type(name) == 1)
        except Exception:  # its parser raises whatever it meets
            return False

    def size(self, name: str) -> int | None:
        """Bytes of a stream, or None where there is none."""
        try:
            return int(self._file.get_size(name))
        except Exception:  # a storage, or nothing of that name
            return None

    def stream(self, name: str, most: int = _MOST_BYTES) -> bytes:
        """The bytes of a stream.

        Raises
        ------
        ValueError
            If there is none, it is longer than `most`, or longer than the file.
        """
        size = self.size(name)
        if size is None:
            raise fail("path", f"a stream {name}", f"none in {self.path}", "it may be no scan")
        if size > min(most, self._size):
            raise fail(name, f"at most {min(most, self._size)} bytes", f"{size} in {self.path}")
        try:
            content = self._file.openstream(name).read()
        except Exception as error:
            raise self._unreadable(error) from error
        if len(content) != size:
            raise self._unreadable(f"{len(content)} of {size} bytes of {name}")
        return content

    def numbers(self, name: str, dtype: str = "<f4") -> np.ndarray:
        """All numbers of a stream, none where there is no such stream."""
        if self.size(name) is None:
            return np.zeros(0, dtype)
        content, size = self.stream(name), np.dtype(dtype).itemsize
        return np.frombuffer(content[: len(content) - len(content) % size], dtype)

    def number(self, name: str, dtype: str = "<f4") -> float | None:
        """The first number of a stream, None where there is none that is finite."""
        found = self.numbers(name, dtype)
        return float(found[0]) if len(found) and np.isfinite(found[0]) else None

    def text(self, name: str) -> str:
        """The text of a stream up to its first zero; nothing where there is none."""
        if self.size(name) is None:
            return ""
        return self.stream(name).split(b"\0")[0].decode("latin-1").strip()

    def texts(self, name: str) -> list[str]:
        """The texts of a stream, a zero after each; none where there is no such stream."""
        if self.size(name) is None:
            return []
        return [text.decode("latin-1").strip() for text in self.stream(name).split(b"\0") if text.strip()]

    def _unreadable(self, error: Any) -> Exception:
        got = f"{self.path} ({str(error)[:120]})"
        return fail("path", "a readable .txrm or .xrm file", got, "it is damaged: copy or write it again")
