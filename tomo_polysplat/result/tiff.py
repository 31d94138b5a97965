"""Volumes as TIFF with the calibration of ImageJ or of OME: one file, or a folder of slices.

ImageJ reads voxel size, unit, window, slope and offset from the description (``ij.io.FileInfo``,
``ij.io.FileOpener.decodeDescriptionString``). It counts y downwards and slices away from the viewer. This is
right-handed, like x, y and z here, so row 0 is the smallest y. After a 2D scan row 0 is the largest y, as in ASTRA's
images, and y points upwards.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import IO, Any, cast

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.files import replacing
from tomo_polysplat.folders import replacing_folder, require_replaceable_folder
from tomo_polysplat.plain_file import PlainFile
from tomo_polysplat.result.image import Image

__all__ = ["require_slices_folder", "require_tiff_size", "write_ome_tiff", "write_tiff", "write_tiff_slices"]

_NAME = re.compile(r"slice_\d{4,}\.tif")
_PROGRAM = "tomo-polysplat"
# Offsets in a TIFF have 32 bits; tifffile needs a part of that for what it writes beside the numbers.
_LARGEST_TIFF = 2**32 - 2**25
# Bytes of a slice's own tags, for the room that a folder needs.
_TAGS = 4096


def write_tiff(image: Image, path: str | os.PathLike, *, overwrite: bool = False) -> None:
    """One file that ImageJ opens as a stack.

    Raises
    ------
    ValueError
        If it is larger than TIFF can hold.
    """
    require_tiff_size(image.values.nbytes)
    metadata = _calibration(image) | {"axes": "ZYX"}
    with replacing(path, overwrite=overwrite, needed_bytes=image.values.nbytes) as temporary:
        _write(temporary, _stacked(image), _tags(image), imagej=True, metadata=metadata)


def require_tiff_size(size: int, argument: str = "path") -> None:
    """Refuse a single TIFF that is too large: most programs would read only its first slice."""
    if size > _LARGEST_TIFF:
        remedy = "name a folder for slices (a name ending in /), an .ome.tif, an .nrrd, or pass bits=16"
        raise fail(argument, "at most 4 GiB for one TIFF", f"{size / 2**30:.1f} GiB", remedy)


def write_ome_tiff(image: Image, path: str | os.PathLike, *, overwrite: bool = False) -> None:
    """One file of any size with OME's metadata, for Bio-Formats, napari and others."""
    metadata: dict[str, Any] = {"axes": "ZYX", "Description": image.about_text()}
    unit = {"um": "µm", "pixel": "pixel"}.get(image.unit, image.unit)
    for axis, size in zip("XYZ", image.voxel_size):
        metadata |= {f"PhysicalSize{axis}": size, f"PhysicalSize{axis}Unit": unit}
    with replacing(path, overwrite=overwrite, needed_bytes=image.values.nbytes) as temporary:
        large = image.values.nbytes > _LARGEST_TIFF
        _write(temporary, _stacked(image), _tags(image), ome=True, bigtiff=large, metadata=metadata)


def write_tiff_slices(image: Image, folder: str | os.PathLike, *, overwrite: bool = False) -> None:
    """A folder of ``slice_0000.tif``, ``slice_0001.tif``, ...; it is written whole or not at all."""
    needed = image.values.nbytes + _TAGS * len(image.values)
    with replacing_folder(folder, _is_ours, overwrite=overwrite, needed_bytes=needed) as temporary:
        for index, picture in enumerate(image.pictures()):
            name = temporary / f"slice_{index:04d}.tif"
            _write(name, picture, _tags(image), imagej=True, metadata=_calibration(image))


def _write(path: Path, values: np.ndarray, tags: dict[str, Any], **options: Any) -> None:
    import tifffile

    with PlainFile(path) as plain:
        # tifffile uses nothing else of a file object.
        file = cast(IO[bytes], plain)
        tifffile.imwrite(file, np.ascontiguousarray(values), photometric="minisblack", **tags, **options)


def _stacked(image: Image) -> np.ndarray:
    """The values with the top row first."""
    return image.values[:, ::-1] if image.top_row == "largest y" else image.values


def require_slices_folder(
    folder: str | os.PathLike,
    *,
    overwrite: bool,
    remedy: str = "pass overwrite=True",
    argument: str = "folder",
) -> Path:
    """The folder of slices to write; refuse one that is, or holds, anything but our slices."""
    return require_replaceable_folder(folder, _is_ours, overwrite=overwrite, remedy=remedy, argument=argument)


def _is_ours(path: Path) -> bool:
    """Whether a file is a slice of ours, by its software tag."""
    import tifffile

    if not _NAME.fullmatch(path.name) or path.is_symlink() or not path.is_file():
        return False
    try:
        with tifffile.TiffFile(path) as file:
            return str(file.pages[0].tags.valueof("Software", "")).startswith(_PROGRAM)
    except Exception:  # a file of another program, or not a TIFF at all
        return False


def _tags(image: Image) -> dict[str, Any]:
    x, y, _ = image.voxel_size
    # TIFF's own unit knows inches and centimetres only, so the description holds the unit.
    return {"resolution": (1 / x, 1 / y), "resolutionunit": "NONE", "software": _PROGRAM}


def _calibration(image: Image) -> dict[str, Any]:
    """What ImageJ reads from the description; ``Info`` is what it shows of the image."""
    low, high = image.stored_window
    known: dict[str, Any] = {
        "unit": image.unit,
        "spacing": image.voxel_size[2],
        "min": low,
        "max": high,
        "Info": image.about_text(),
    }
    if image.values.dtype.kind == "u":
        # cf=0 is a straight line, c0 + c1 * number.
        known |= {"cf": 0, "c0": image.offset, "c1": image.slope, "vunit": image.quantity}
    if image.top_row == "smallest y":
        origin = [0.5 - at / size for at, size in zip(image.first, image.voxel_size)]
        known |= dict(zip(("xorigin", "yorigin", "zorigin"), origin))
    return known
