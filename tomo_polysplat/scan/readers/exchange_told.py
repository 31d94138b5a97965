"""Data Exchange that states no geometry, of a scanner that the user describes: its pictures, and angles if it has them.

Of a cone beam its first row is taken for the top one and its pictures as seen from the source, as a camera writes them.
Of a parallel beam the first row is the first slice, as TomoPy and `load_scan` without a description have it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.scan.data_exchange_pictures import input_kind, pictures_of, references_of
from tomo_polysplat.scan.hdf5 import find_array, find_group, is_in_radians, opened, read_numbers, read_text
from tomo_polysplat.scan.readers.acquisition import Acquisition
from tomo_polysplat.scan.readers.frames import ArrayFrames, Frames, Hdf5Frames
from tomo_polysplat.scan.readers.picture_stack import full_turn, guessed
from tomo_polysplat.scan.readers.stated import require_known, stated_over

if TYPE_CHECKING:
    import h5py

__all__ = ["KIND", "is_described", "read"]

KIND = "Data Exchange (HDF5)"
# What is said of the parallel beam that a file without geometry is taken for.
_OF_PARALLEL = {"beam", "arc", "degrees", "pixel"}


def is_described(stated: Mapping[str, Any]) -> bool:
    """Whether more is stated than angles and pixel of a parallel beam."""
    known = require_known(stated, "scanner")
    return bool(known.keys() - _OF_PARALLEL) or known.get("beam", "parallel") != "parallel"


def read(path: Path, stated: Mapping[str, Any]) -> Acquisition:
    """What the file has, as a stack of pictures with what the user states of the scanner.

    Parameters
    ----------
    path : Path
    stated : mapping
        By the names of `tomo_polysplat.scan.readers.stated.KEYS`.

    Raises
    ------
    ValueError
        If the file has a geometry, or no pictures, or a distance is missing.
    """
    known = require_known(stated, "scanner")
    with opened(path) as file:
        if find_group(file, "polysplat/geometry") is not None:
            got = ", ".join(map(str, stated))
            raise fail("scanner", "nothing for a scan that has its own geometry", got, "leave it out")
        data = pictures_of(file, path)
        white, dark = (_frames(file, name, data.shape[1:]) for name in ("data_white", "data_dark"))
        degrees = _degrees(file, len(data))
        told = Acquisition(
            KIND,
            Hdf5Frames(data, np.arange(len(data))),
            full_turn(len(data)),
            read_text(file, "measurement/sample/name") or path.stem,
            input=input_kind(
                data, white is not None or bool({"flats", "white"} & known.keys()), known.get("input")
            ),
            flats=white,
            darks=dark,
            top_first=known.get("beam") != "parallel",
        )
    if degrees is not None and not {"degrees", "arc"} & known.keys():
        known["degrees"] = degrees
    return guessed(stated_over(told, known, path.parent), known)


def _frames(file: h5py.File, name: str, size: tuple[int, ...]) -> Frames | None:
    """Pictures of the open beam or of no light; one alone may have no axis for their number."""
    found = references_of(file, name)
    if len(found) == 1 and found[0].ndim == 3:
        return Hdf5Frames(found[0], np.arange(len(found[0])))
    parts = [
        read_numbers(file, frames.name, (*frames.shape[:-2], *size)).reshape(-1, *size) for frames in found
    ]
    return ArrayFrames(np.concatenate(parts)) if parts else None


def _degrees(file: h5py.File, views: int) -> np.ndarray | None:
    dataset = find_array(file, "exchange/theta")
    if dataset is None:
        return None
    angles = read_numbers(file, "exchange/theta", (views,)).astype(np.float64)
    return np.rad2deg(angles) if is_in_radians(dataset) else angles
