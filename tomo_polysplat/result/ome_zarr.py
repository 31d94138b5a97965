"""Volumes as OME-Zarr, a folder of small blocks in several resolutions (https://ngff.openmicroscopy.org/0.4/).

Version 0.4 lies in Zarr's second format, which every reader of OME-Zarr knows: texts of JSON, and blocks of plain
numbers. Blocks of zeros are left out, as the format allows.
"""

from __future__ import annotations

import itertools
import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from tomo_polysplat.folders import replacing_folder, require_replaceable_folder
from tomo_polysplat.plain_file import PlainFile
from tomo_polysplat.result.image import Image

__all__ = ["require_zarr_folder", "write_ome_zarr"]

# Voxels along a side of a block; a resolution that fits into one is the last.
_BLOCK = 128
_UNITS = {"m": "meter", "cm": "centimeter", "mm": "millimeter", "um": "micrometer"}
_PROGRAM = "tomo-polysplat"
_WHAT = "an OME-Zarr volume of ours"
_INSIDE = re.compile(r"\.zarray|\d+(/\d+)*")


def write_ome_zarr(image: Image, path: str | os.PathLike, *, overwrite: bool = False) -> None:
    """A folder with the volume and its halved, quartered, ... copies; it is written whole or not at all.

    Slope, offset and what else the numbers mean stand under ``tomo-polysplat`` in ``.zattrs``.
    """
    known = {"overwrite": overwrite, "what": _WHAT, "needed_bytes": image.values.nbytes * 8 // 7}
    with replacing_folder(path, _is_ours, **known) as folder:  # type: ignore[arg-type]
        values, factors, datasets = image.values, np.ones(3, int), []
        for level in itertools.count():
            _write_level(folder / str(level), values)
            datasets.append(_dataset(image, level, factors))
            if max(values.shape) <= _BLOCK:
                break
            factors = np.where(np.array(values.shape) > 1, 2, 1) * factors
            values = _halved(values)
        (folder / ".zgroup").write_text('{"zarr_format": 2}\n', encoding="ascii")
        # Last of all: what has none is no volume.
        (folder / ".zattrs").write_text(
            json.dumps(_about(image, datasets), indent=2) + "\n", encoding="utf-8"
        )


def require_zarr_folder(folder: str | os.PathLike, **known: Any) -> Path:
    """The folder to write; refuse one that is, or holds, anything but such a volume of ours."""
    return require_replaceable_folder(folder, _is_ours, what=_WHAT, **known)


def _is_ours(path: Path) -> bool:
    """Whether a part of a folder belongs to a volume that was written here."""
    try:
        about = json.loads((path.parent / ".zattrs").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    if path.is_symlink() or not isinstance(about, dict) or _PROGRAM not in about:
        return False
    if path.name in (".zattrs", ".zgroup"):
        return path.is_file()
    files = (file.relative_to(path).as_posix() for file in path.rglob("*"))
    return path.is_dir() and path.name.isdecimal() and all(_INSIDE.fullmatch(file) for file in files)


def _write_level(folder: Path, values: np.ndarray) -> None:
    """One resolution: blocks of a single size, the last ones filled up with zeros."""
    block = tuple(min(_BLOCK, n) for n in values.shape)
    stored = values.dtype.newbyteorder("<")
    about = {
        "zarr_format": 2,
        "shape": list(values.shape),
        "chunks": list(block),
        "dtype": stored.str,
        "fill_value": 0,
        "order": "C",
        "compressor": None,
        "filters": None,
        "dimension_separator": "/",
    }
    folder.mkdir()
    (folder / ".zarray").write_text(json.dumps(about, indent=2) + "\n", encoding="ascii")
    for place in itertools.product(*(range(-(-n // size)) for n, size in zip(values.shape, block))):
        part = values[tuple(slice(k * size, (k + 1) * size) for k, size in zip(place, block))]
        if not part.any():
            continue
        filled = np.zeros(block, stored)
        filled[tuple(slice(n) for n in part.shape)] = part
        file = folder.joinpath(*map(str, place))
        file.parent.mkdir(parents=True, exist_ok=True)
        with PlainFile(file) as plain:
            plain.write(filled.data)


def _halved(values: np.ndarray) -> np.ndarray:
    """Means of 2 x 2 x 2 voxels, in their type; the last of an odd number stands for two, a single one for itself."""
    stored = values.dtype
    for axis, n in enumerate(values.shape):
        if n == 1:
            continue
        first = np.take(values, range(0, n, 2), axis)
        second = np.take(values, np.minimum(np.arange(1, n + 1, 2), n - 1), axis)
        values = 0.5 * (first.astype(np.float32) + second.astype(np.float32))
    return np.rint(values).astype(stored) if np.issubdtype(stored, np.integer) else values


def _dataset(image: Image, level: int, factors: np.ndarray) -> dict[str, Any]:
    """Where the voxels of a resolution are: size, and centre of the first, as (z, y, x)."""
    size, first = (np.array(lengths[::-1]) for lengths in (image.voxel_size, image.first))
    moves = {"scale": size * factors, "translation": first + 0.5 * (factors - 1) * size}
    transformations = [
        {"type": name, name: [float(f"{x:.12g}") for x in move]} for name, move in moves.items()
    ]
    return {"path": str(level), "coordinateTransformations": transformations}


def _about(image: Image, datasets: list[dict[str, Any]]) -> dict[str, Any]:
    unit = {"unit": _UNITS[image.unit]} if image.unit in _UNITS else {}
    low, high = image.stored_window
    least, most = float(np.nanmin(image.values)), float(np.nanmax(image.values))
    channel = {
        "label": "HU" if image.quantity == "HU" else f"attenuation ({image.quantity})",
        "color": "FFFFFF",
        "active": True,
        "window": {"min": min(least, low), "max": max(most, high), "start": low, "end": high},
    }
    multiscale = {
        "version": "0.4",
        "name": "volume",
        "axes": [{"name": axis, "type": "space", **unit} for axis in "zyx"],
        "datasets": datasets,
        "type": "mean of 2 x 2 x 2",
    }
    return {
        "multiscales": [multiscale],
        "omero": {"version": "0.4", "channels": [channel]},
        _PROGRAM: image.about(),
    }
