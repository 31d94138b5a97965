"""Stacks of pictures in files of ITK's: MetaImage and its like."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.files import existing_file, require_plausible_size

__all__ = ["ITK_SUFFIXES", "ItkFrames"]

ITK_SUFFIXES = (".mha", ".mhd")


class ItkFrames:
    """Pictures (pictures, rows, columns) of one file, a picture being its plane of x and y.

    Attributes
    ----------
    origin, spacing : (x, y)
        Of the first pixel's middle, and from pixel to pixel.
    """

    def __init__(self, path: Path) -> None:
        self._path = existing_file(path)
        reader = self._reader()
        columns, rows, count = (*reader.GetSize(), 1, 1)[:3]
        if reader.GetNumberOfComponents() != 1 or reader.GetDimension() > 3:
            got = f"{reader.GetDimension()} axes with {reader.GetNumberOfComponents()} values each in {path}"
            raise fail("path", "a stack of pictures of grey values", got)
        self.shape = (int(count), int(rows), int(columns))
        self.origin, self.spacing = reader.GetOrigin()[:2], reader.GetSpacing()[:2]
        if path.suffix.lower() == ".mha":
            require_plausible_size(path.name, int(np.prod(self.shape)), path.stat().st_size)
        self.dtype = self.read(0, slice(0, 1), slice(0, 1)).dtype

    def read(self, index: int, rows: slice, columns: slice) -> np.ndarray:
        """Part of one picture."""
        from SimpleITK import GetArrayFromImage

        reader = self._reader()
        first = (columns.start, rows.start, index)[: reader.GetDimension()]
        size = (columns.stop - columns.start, rows.stop - rows.start, 1)[: reader.GetDimension()]
        reader.SetExtractIndex(first)
        reader.SetExtractSize(size)
        try:
            picture = GetArrayFromImage(reader.Execute())
        except RuntimeError as error:
            raise self._unreadable(error) from error
        return picture.reshape(picture.shape[-2:])

    def _reader(self) -> Any:
        try:
            from SimpleITK import ImageFileReader
        except ImportError as error:
            remedy = "python -m pip install 'tomo-polysplat[scanners]'"
            raise fail(
                "path", "SimpleITK, which reads MetaImage files", "none", remedy, ImportError
            ) from error
        reader = ImageFileReader()
        reader.SetFileName(str(self._path))
        try:
            reader.ReadImageInformation()
        except RuntimeError as error:
            raise self._unreadable(error) from error
        return reader

    def _unreadable(self, error: Exception) -> Exception:
        words = str(error).strip().splitlines()[-1][-160:]
        return fail(
            "path", "a readable MetaImage file", f"{self._path} ({words})", "copy or write the file again"
        )
