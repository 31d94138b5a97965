"""The pictures of files of any kind that a plain stack may have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.files import existing_file
from tomo_polysplat.scan.readers.edf import EdfFrames
from tomo_polysplat.scan.readers.frames import OTHER_PICTURE, ArrayFrames, Frames, TiffFrames
from tomo_polysplat.scan.readers.xradia_frames import xrm_pictures

__all__ = ["NpyFrames", "frames_of", "mapped_npy"]


class NpyFrames:
    """Pictures of NumPy's ``.npy`` files, mapped and not read: one file of (pictures, rows, columns), or one a picture.

    Raises
    ------
    ValueError
        For files that are none, and pictures of different sizes or types.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self._files = [existing_file(file) for file in files]
        first = mapped_npy(self._files[0])
        self._stack = ArrayFrames(first) if first.ndim == 3 and len(self._files) == 1 else None
        if self._stack is None and (first.ndim != 2 or first.dtype.kind not in "fiu"):
            got = f"{first.dtype} of shape {first.shape} in {self._files[0]}"
            raise fail(
                "path", "one stack (pictures, rows, columns), or a picture (rows, columns) in each", got
            )
        shape = first.shape if self._stack is not None else (len(self._files), *first.shape)
        self.shape, self.dtype = (shape[0], shape[1], shape[2]), first.dtype

    def read(self, index: int, rows: slice, columns: slice) -> np.ndarray:
        """Part of one picture."""
        if self._stack is not None:
            return self._stack.read(index, rows, columns)
        picture = mapped_npy(self._files[index])
        if picture.shape != self.shape[1:] or picture.dtype != self.dtype:
            got = f"{picture.dtype} of {picture.shape} in {self._files[index]}"
            expected = f"{self.dtype} of {self.shape[1:]} as in {self._files[0].name}"
            raise fail("path", expected, got, OTHER_PICTURE)
        return np.asarray(picture[rows, columns])


def mapped_npy(file: Path) -> np.ndarray:
    """The array of a ``.npy`` file, of which nothing is read yet.

    Raises
    ------
    ValueError
        If there is none.
    """
    try:
        return np.load(file, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # headers are texts of Python, whose parser raises whatever it meets
        got = f"{file} ({str(error)[:120]})"
        raise fail("path", "a .npy file of numbers", got, "save it again with numpy.save") from error


_READERS: dict[str, Callable[[Sequence[Path]], Frames]] = {
    ".npy": NpyFrames,
    ".edf": EdfFrames,
    ".txrm": xrm_pictures,
    ".xrm": xrm_pictures,
}


def frames_of(files: Sequence[Path]) -> Frames:
    """Pictures of TIFF, ``.npy``, EDF, .txrm or .xrm files, told apart by the first one's name.

    Raises
    ------
    ValueError
        For files that are not what their name says, and for files of several kinds.
    """
    kinds = {file.suffix.lower().replace("tiff", "tif") for file in files}
    if len(kinds) > 1:
        raise fail("path", "pictures of one kind of file", ", ".join(sorted(kinds)))
    return _READERS.get(kinds.pop() if kinds else "", TiffFrames)(files)
