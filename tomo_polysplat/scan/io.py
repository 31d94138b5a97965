"""Scans from files and into files."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tomo_polysplat.checks import fail
from tomo_polysplat.files import existing_file
from tomo_polysplat.scan.data_exchange import scan_from_hdf5
from tomo_polysplat.scan.data_exchange_writer import write_hdf5
from tomo_polysplat.scan.hdf5 import find_array, find_group, opened
from tomo_polysplat.scan.npz import scan_from_npz, write_npz
from tomo_polysplat.scan.readers import cil_nexus, exchange_told, npz_stack, nxtomo
from tomo_polysplat.scan.readers.part import Part
from tomo_polysplat.scan.readers.recognise import acquisition_of
from tomo_polysplat.scan.readers.scan_part import scan_part
from tomo_polysplat.scan.readers.stated import require_known, view_degrees, with_options
from tomo_polysplat.scan.readers.to_scan import scan_from_acquisition
from tomo_polysplat.scan.reading import ReadOptions
from tomo_polysplat.scan.scan import Scan

if TYPE_CHECKING:
    from tomo_polysplat.physics.spectrum import Spectrum

__all__ = ["is_of_scanner", "load_scan", "require_scan_name", "save_scan"]

_WRITERS: dict[str, Callable[..., None]] = {".npz": write_npz, ".h5": write_hdf5, ".hdf5": write_hdf5}


# One parameter for each option that a caller names.
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
    scanner: Mapping[str, Any] | None = None,
    rows: tuple[int, int] | None = None,
    columns: tuple[int, int] | None = None,
    views: Any = None,
    binning: int = 1,
    progress: bool | Callable[[float, str], Any] | None = None,
) -> Scan:
    """Read a scan: a Data Exchange HDF5 file, an ``.npz`` scan, or what a scanner leaves in a folder.

    Of pictures in a folder, or in a file, those that are wanted alone are read. What had to be guessed is said in the
    log and in ``scan.notes["scanner"]``, with the keys of the scanner's own text that are not used.

    A Data Exchange file that states no geometry is taken as a parallel beam with the angles in
    ``/exchange/theta`` (degrees), unless `scanner` describes another. Rays without light, saturated, of dead pixels
    or not finite are marked in ``scan.valid`` and counted in ``scan.notes``, never clipped.

    Parameters
    ----------
    path : path
        The file or the folder; its contents decide what it is, not its name.
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
        then no truth is read. Without one the volume is as many voxels across as there are columns, or as
        wide as a whole turn sees of a detector beside the axis, if matter lies there.
    water_correction : sequence of float or None
        Polynomial that the projections have been put through, instead of the file's; see :class:`Scan`.
    scanner : mapping, optional
        What no file says, by the names that stand in ``docs/scanner_files.md``, such as ``{"source_object": 200,
        "source_detector": 500, "pixel": 0.1, "arc": 360, "flats": "flat*.tif"}`` in mm. A file ``scan.toml`` in the
        folder says the same.
    rows, columns : (first, end), optional
        Part of the pictures to read, counted as a viewer of pictures does, from the top left at 0; those of an HDF5
        or ``.npz`` scan as its arrays are.
    views : int, (first, end) or (first, end, step), optional
        Views to read; a number alone is the step.
    binning : int
        Rows and columns whose light is averaged to one.
    progress : bool, callable or None
        Whether to draw a bar, as in `tomo_polysplat.reconstruct`; or a function of (share done, words). None draws it
        in a notebook and on a terminal, for what takes more than a moment. Not for ``.npz`` scans.

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
    options = ReadOptions(*stated, water_correction, progress)
    part = Part(rows, columns, views, binning)
    reader = _reader_of_scans(Path(path))
    if reader is None:
        told = acquisition_of(Path(path), with_options(scanner or {}, options))
        return scan_from_acquisition(told, options, part)
    if scanner and reader is scan_from_hdf5:
        if exchange_told.is_described(scanner):
            told = exchange_told.read(existing_file(path), with_options(scanner, options))
            return scan_from_acquisition(told, options, part)
        options = _of_parallel_beam(existing_file(path), options, scanner)
    elif scanner:
        got = ", ".join(map(str, scanner))
        raise fail("scanner", "nothing for a scan that has its own geometry", got, "leave it out")
    if reader is scan_from_hdf5:
        return scan_from_hdf5(existing_file(path), options, part)
    scan = reader(existing_file(path), options)
    return scan if part.whole else scan_part(scan, part, options.vol_geom)


def is_of_scanner(path: str | os.PathLike, scanner: Mapping[str, Any]) -> bool:
    """Whether `load_scan` takes what is there for what a scanner wrote, of which `scanner` may tell the tube too."""
    reader = _reader_of_scans(Path(path))
    return reader is None or (reader is scan_from_hdf5 and exchange_told.is_described(scanner))


def _of_parallel_beam(file: Path, options: ReadOptions, scanner: Mapping[str, Any]) -> ReadOptions:
    """Angles and pixel of a Data Exchange file that has none, as they are told of pictures."""
    known = require_known(scanner, "scanner")
    with opened(file) as content:
        group = find_group(content, "exchange")
        data = None if group is None else find_array(group, "data")
        views = 0 if data is None or data.ndim != 3 else data.shape[0]
    theta = view_degrees(known, file.parent, views) if views else None
    options = options if theta is None else replace(options, theta=theta)
    if "pixel" not in known:
        return options
    return replace(options, pixel_size=known["pixel"], unit=options.unit or "mm")


def _reader_of_scans(path: Path) -> Callable[[Path, ReadOptions], Scan] | None:
    """What reads the package's own kinds of files; None for what scanners write."""
    if path.is_dir():
        return None
    file = existing_file(path)
    if zipfile.is_zipfile(file):
        return None if npz_stack.recognises(file) else scan_from_npz
    with open(file, "rb") as stream:
        start = stream.read(4)
    if start == b"PK\x03\x04":
        raise fail(
            "path", "a complete .npz archive", str(file), "it is truncated: copy or write the file again"
        )
    if start != b"\x89HDF" or nxtomo.recognises(file) or cil_nexus.recognises(file):
        return None
    return scan_from_hdf5


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
    _WRITERS[require_scan_name(path)](scan, Path(path), overwrite=overwrite)


def require_scan_name(path: str | os.PathLike, argument: str = "path") -> str:
    """The ending of a name that a scan can be saved under; refuses others, before the work begins."""
    suffix = Path(path).suffix.lower()
    if suffix not in _WRITERS:
        remedy = "a scan is no volume: `recon` writes those"
        raise fail(argument, f"a name ending in {', '.join(_WRITERS)}", str(path), remedy)
    return suffix
