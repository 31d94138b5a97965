"""Scans from files and into files."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tomo_polysplat.checks import fail
from tomo_polysplat.files import existing_file
from tomo_polysplat.scan.data_exchange import scan_from_hdf5
from tomo_polysplat.scan.data_exchange_writer import write_hdf5
from tomo_polysplat.scan.npz import scan_from_npz, write_npz
from tomo_polysplat.scan.reading import ReadOptions
from tomo_polysplat.scan.scan import Scan

if TYPE_CHECKING:
    from tomo_polysplat.physics.spectrum import Spectrum

__all__ = ["load_scan", "save_scan"]


def load_scan(
    path: str | os.PathLike,
    *,
    spectrum: Spectrum | None = None,
    unit: str | None = None,
    centre: float | None = None,
    pixel_size: float | None = None,
    theta: Any = None,
    input: str | None = None,
    saturation: float | None = None,
    proj_geom: Mapping[str, Any] | None = None,
    vol_geom: Mapping[str, Any] | None = None,
    water_correction: Sequence[float] | None = None,
) -> Scan:
    """Read a scan from a Data Exchange HDF5 file or an ``.npz`` scan.

    A Data Exchange file that states no geometry is taken as a parallel beam with the angles in
    ``/exchange/theta`` (degrees). Rays without light, saturated, of dead pixels or not finite are marked in
    ``scan.valid`` and counted in ``scan.notes``, never clipped.

    Parameters
    ----------
    path : path
        The file; its contents decide what it is, not its name.
    spectrum : Spectrum or None
        Used instead of the file's.
    unit : str or None
        Unit of the lengths where the file states none: ``"cm"`` (default), ``"mm"``, ``"um"``, ``"m"``. A
        parallel beam of unknown pixel size is in ``"pixel"``, its attenuation in 1/pixel.
    centre : float or None
        Parallel beam: rotation axis in columns from the detector's edge, as in TomoPy (``columns / 2`` is the
        middle); None estimates it from opposite views.
    pixel_size : float or None
        Parallel beam: side of a square pixel in the plane of the object, in `unit`.
    theta : array, shape (views,), or None
        Parallel beam: angles in degrees, instead of the file's.
    input : {"counts", "transmission", "attenuation"} or None
        What a Data Exchange file holds; None goes by its attribute, its open-beam images, or, with a
        warning, by the numbers.
    saturation : float or None
        Counts at which the detector saturates; None takes the largest value of an integer type.
    proj_geom, vol_geom : dict or None
        ASTRA geometries (three-dimensional types) instead of the file's; `vol_geom` may be given alone, and
        then no truth is read.
    water_correction : sequence of float or None
        Polynomial that the projections have been put through, instead of the file's; see :class:`Scan`.

    Returns
    -------
    Scan
        With projections in ASTRA's order (rows, views, columns).

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is damaged or of another kind, or leaves a choice open that must be made.
    MemoryError
        If an array is larger than the free memory.
    """
    stated = (spectrum, unit, centre, pixel_size, theta, input, saturation, proj_geom, vol_geom)
    options = ReadOptions(*stated, water_correction)
    file = existing_file(path)
    if zipfile.is_zipfile(file):
        return scan_from_npz(file, options)
    with open(file, "rb") as stream:
        start = stream.read(4)
    if start == b"PK\x03\x04":
        raise fail(
            "path", "a complete .npz archive", str(file), "it is truncated: copy or write the file again"
        )
    if start != b"\x89HDF":
        raise fail("path", "a Data Exchange HDF5 file or an .npz scan", f"{file}, which is neither")
    return scan_from_hdf5(file, options)


def save_scan(scan: Scan, path: str | os.PathLike, *, overwrite: bool = False) -> None:
    """Write a scan so that :func:`load_scan` returns it, spectrum and truth included.

    Parameters
    ----------
    scan : Scan
        What to write.
    path : path
        ``.npz`` or ``.h5``/``.hdf5`` (Data Exchange), told apart by the name's ending.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    FileExistsError
        If the file exists and `overwrite` is false.
    ValueError
        For another ending.
    """
    writers = {".npz": write_npz, ".h5": write_hdf5, ".hdf5": write_hdf5}
    suffix = Path(path).suffix.lower()
    if suffix not in writers:
        raise fail("path", "a name ending in .npz, .h5 or .hdf5", str(path))
    writers[suffix](scan, Path(path), overwrite=overwrite)
