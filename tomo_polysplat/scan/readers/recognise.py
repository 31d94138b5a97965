"""Which reader a folder or a file is for, by what is there."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tomo_polysplat.checks import fail
from tomo_polysplat.scan.readers import (
    cil_nexus,
    nikon,
    npz_stack,
    nxtomo,
    picture_stack,
    rtk,
    skyscan,
    xradia,
)
from tomo_polysplat.scan.readers.acquisition import Acquisition

__all__ = ["acquisition_of"]

# The first one that recognises what it is shown reads it: what any folder of pictures is comes last.
READERS = (skyscan, nikon, xradia, nxtomo, cil_nexus, rtk, npz_stack, picture_stack)
_REMEDY = (
    "name the folder or the file that the scanner wrote; docs/scanner_files.md tells what is read of each"
)


def acquisition_of(path: Path, stated: Mapping[str, Any]) -> Acquisition:
    """What a scanner's folder or file tells.

    Parameters
    ----------
    path : Path
    stated : mapping
        What the user states, by the names of `tomo_polysplat.scan.readers.stated.KEYS`.

    Raises
    ------
    ValueError
        If no reader recognises it.
    """
    for reader in READERS:
        if reader.recognises(path):
            return reader.read(path, stated)
    kinds = ", ".join(reader.KIND for reader in READERS)
    raise fail(
        "path",
        f"a Data Exchange HDF5 file, an .npz scan, or one of: {kinds}",
        f"{path}, which is none of these",
        _REMEDY,
    )
