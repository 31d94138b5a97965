"""The filter of each pixel: in a Data Exchange file, and as a picture or a table of its thickness."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.files import existing_file, file_content
from tomo_polysplat.scan.hdf5 import find_array, find_group, number_attribute, read_numbers, text_attribute

if TYPE_CHECKING:
    import h5py

    from tomo_polysplat.scan.scan import Scan

__all__ = ["read_filter_map", "thickness_of", "write_filter_map"]

_NAME = "filter_thickness"
# Of a table of text: ten times what a detector of 4096 x 4096 pixels needs.
_MOST_BYTES = 1 << 31


def read_filter_map(file: h5py.File, shape: tuple[int, ...]) -> tuple[Any, ...] | None:
    """`Scan.filter_map` of a scan whose projections have such a ``shape`` (rows, views, columns); None without one."""
    group = find_group(file, "polysplat")
    stored = None if group is None else find_array(group, _NAME)
    if group is None or stored is None:
        return None
    material, density = text_attribute(stored, "material"), number_attribute(stored, "density")
    if material is None:
        raise fail("path", f"the attribute 'material' of /polysplat/{_NAME}", "none")
    thickness = read_numbers(group, _NAME, most=shape[0] * shape[2])
    return (material, thickness) if density is None else (material, thickness, density)


def write_filter_map(group: h5py.Group, scan: Scan) -> None:
    """Into the group ``/polysplat``."""
    if scan.filter_map is None:
        return
    material, thickness, density = scan.filter_map
    group[_NAME] = thickness
    group[_NAME].attrs.update(material=material, density=density, unit=scan.unit)


def thickness_of(path: str | os.PathLike, argument: str = "path") -> np.ndarray:
    """Thickness at each pixel, (rows, columns), of a ``.npy`` file, a TIFF or a table of text; one row stands for all.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it holds no such numbers.
    """
    from tomo_polysplat.scan.readers.picture_files import frames_of, mapped_npy
    from tomo_polysplat.scan.readers.picture_names import PICTURE_SUFFIXES

    file = existing_file(path, argument)
    if file.suffix.lower() not in PICTURE_SUFFIXES:
        return _table(file, argument)
    if file.suffix.lower() == ".npy" and (row := mapped_npy(file)).ndim == 1 and row.dtype.kind in "fiu":
        return np.array(row[None], np.float64)
    frames = frames_of([file])
    if frames.shape[0] != 1:
        raise fail(argument, "one picture (rows, columns)", f"{frames.shape[0]} in {file}")
    return frames.read(0, slice(0, frames.shape[1]), slice(0, frames.shape[2]))


def _table(file: Path, argument: str) -> np.ndarray:
    lines = file_content(file, _MOST_BYTES, argument).decode("utf-8", "replace").splitlines()
    rows = [line.partition("#")[0].replace(",", " ").replace(";", " ").split() for line in lines]
    try:
        return np.array([[float(word) for word in row] for row in rows if row], float).reshape(
            sum(map(bool, rows)), -1
        )
    except ValueError as error:
        remedy = "write a line of numbers for each row of pixels"
        raise fail(argument, "rows of as many numbers each", f"{file} ({error})", remedy) from error
