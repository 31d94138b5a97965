"""Folders as scanners write them, by the scanner's name."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from tomo_polysplat.checks import fail, require_choice
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.simulate.folders import arrays, cil, nikon, nxtomo, rtk, skyscan, tiffs, xradia
from tomo_polysplat.simulate.folders.scene import marked_scan, pictures_of

__all__ = ["KINDS", "scan_for", "write_folder"]

KINDS = {
    "tiffs": tiffs.write,
    "npy": arrays.write_npy,
    "npz": arrays.write_npz,
    "edf": arrays.write_edf,
    "esrf": arrays.write_esrf,
    "skyscan": skyscan.write,
    "nikon": nikon.write,
    "nxtomo": nxtomo.write,
    "rtk": rtk.write,
    "cil": cil.write,
    "xradia": xradia.write,
    "xrm": xradia.write_single_views,
}
# What is of its own in the geometry of a kind.
_GEOMETRY: dict[str, dict[str, Any]] = {
    "nikon": {"columns_off": 0.0, "aside": nikon.ASIDE},
    "esrf": {"columns_off": 0.0, "beam": "parallel"},
}


def scan_for(kind: str, **size: Any) -> Scan:
    """A scan that a kind of scanner can write; `size` may have views, rows, columns and seed of `marked_scan`."""
    require_choice("kind", kind, KINDS)
    return marked_scan(**size, **_GEOMETRY.get(kind, {}))


def write_folder(kind: str, folder: str | os.PathLike, scan: Scan | None = None) -> Scan:
    """Make a folder of a kind of scanner; returns the scan that was written.

    Parameters
    ----------
    kind : str
        One of `KINDS`.
    folder : path
        A new one.
    scan : Scan, optional
        One of `scan_for`; by default that of the usual size.

    Raises
    ------
    FileExistsError
        If there is something in the folder.
    """
    require_choice("kind", kind, KINDS)
    target = Path(folder)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise fail("folder", "a new or empty folder", str(target), "name another", FileExistsError)
    target.mkdir(parents=True, exist_ok=True)
    scan = scan_for(kind) if scan is None else scan
    KINDS[kind](target, pictures_of(scan))
    return scan
