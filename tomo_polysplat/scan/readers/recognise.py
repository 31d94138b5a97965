"""Which reader a folder or a file is for, by what is there."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from tomo_polysplat.checks import fail, visible
from tomo_polysplat.scan.readers import (
    cil_nexus,
    esrf,
    nikon,
    npz_stack,
    nxtomo,
    picture_stack,
    rtk,
    skyscan,
    xradia,
)
from tomo_polysplat.scan.readers.acquisition import Acquisition
from tomo_polysplat.scan.readers.entries import entries_of
from tomo_polysplat.scan.readers.files_of_scans import the_one
from tomo_polysplat.scan.readers.other_makers import what_is_told
from tomo_polysplat.scan.readers.picture_names import PICTURE_SUFFIXES, is_reconstructed, pictures_in

__all__ = ["acquisition_of"]

_MOST_FOLDERS = 100
_MOST_NAMED = 3
# Pictures for the eye.
_LOSSY = {".jpg", ".jpeg", ".png", ".bmp", ".gif"}
# Those that read a TOML file themselves, of any name.
_OF_ANY_TOML = (npz_stack, picture_stack)
# The first one that recognises what it is shown reads it: what any folder of pictures is comes last.
READERS = (skyscan, nikon, xradia, nxtomo, cil_nexus, rtk, esrf, npz_stack, picture_stack)
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
    for reader in READERS[:-1]:
        if reader.recognises(path):
            return _read(reader, path, stated)
    if path.is_dir() and not (pictures_in(path) or picture_stack.toml_files(path)):
        inside = [(folder, reader) for folder in _folders_of_scans(path) for reader in READERS[:-1]]
        scans = [(folder, reader) for folder, reader in inside if reader.recognises(folder)]
        if scans:
            folder = the_one([folder for folder, _ in scans], "one scan in the folder", "name one")
            return _read(scans[0][1], folder, stated).saying(f"what is read is {folder.name} in {path.name}")
    if picture_stack.recognises(path):
        if path.is_file() and "pixel" not in stated:
            _refuse_one_picture(path)
        return picture_stack.read(path, stated)
    told = what_is_told(path)
    if told is not None:
        remedy = (
            f"import the folder of its TIFFs with {told[1]}; ImageJ makes TIFFs of raw pictures (Import, Raw)"
        )
        raise fail("path", "the pictures of a scan", f"{told[0]}, which is not read", remedy)
    kinds = ", ".join(reader.KIND.split(" (")[0] for reader in READERS)
    raise fail(
        "path",
        f"a Data Exchange HDF5 file, an .npz scan, or one of: {kinds}",
        f"{path}, which is none of these",
        _remedy(path),
    )


def _read(reader: Any, path: Path, stated: Mapping[str, Any]) -> Acquisition:
    """By this reader, with what stands in a file scan.toml beside a scanner's own text."""
    beside = (path if path.is_dir() else path.parent) / "scan.toml"
    if reader in _OF_ANY_TOML or not beside.is_file():
        return reader.read(path, stated)
    written, other = picture_stack.written_beside(beside)
    told = reader.read(path, picture_stack.stated_beside(written, stated))
    keys = ", ".join(written) or "nothing that is known"
    return replace(told, other={**told.other, **other}).saying(f"scan.toml beside it is followed: {keys}")


def _refuse_one_picture(path: Path) -> None:
    """Refuse a picture of a scan whose text, which tells the distances, stands beside it."""
    folder = path.parent
    told = bool(picture_stack.toml_files(folder)) or any(r.recognises(folder) for r in READERS[:-1])
    if told and path.suffix.lower() in PICTURE_SUFFIXES:
        remedy = f"name the folder: {visible(folder.resolve().name)}"
        raise fail("path", "a scan", f"{path}, one of its pictures", remedy)


def _remedy(path: Path) -> str:
    """What to do about the files that are there."""
    files = [file for file in (entries_of(path) if path.is_dir() else [path]) if file.is_file()]
    suffixes = {file.suffix.lower() for file in files}
    scans = [file.name for file in files if file.suffix.lower() in (".h5", ".hdf5")]
    if suffixes & _LOSSY:
        return (
            "its pictures are not read: save them as TIFFs of 16 bits (ImageJ: File, Save As, Image Sequence)"
        )
    if scans and path.is_dir():
        return f"name the file of the scan: {', '.join(scans[:_MOST_NAMED])}"
    if ".npz" in suffixes:
        return "call the arrays of the .npz file projections, flats, darks and degrees"
    return _REMEDY


def _folders_of_scans(path: Path) -> list[Path]:
    inside = sorted(
        folder for folder in entries_of(path) if folder.is_dir() and os.access(folder, os.R_OK | os.X_OK)
    )
    return [folder for folder in inside if not is_reconstructed(folder)][:_MOST_FOLDERS]
