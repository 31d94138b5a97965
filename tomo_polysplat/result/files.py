"""Results in files.

The HDF5 file follows Data Exchange: ``/exchange/data`` (z, y, x) is the volume, with attributes ``unit``,
``energy_kev``, ``voxel_size`` and ``origin`` (x, y, z; the centre of the first voxel). What everything else
is computed from stands in ``/polysplat``: ``basis``, ``gaussians``, ``spectrum``, and as JSON text
``history``, ``plan``, ``counts``, ``settings`` and ``materials``. y ascends with the index, also after a 2D
scan.
"""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.files import existing_parent, replacing, require_room, require_writable
from tomo_polysplat.physics.materials import Materials
from tomo_polysplat.result.result import GAUSSIAN_PARTS, Result
from tomo_polysplat.scan.geometry import VolumeGrid
from tomo_polysplat.scan.hdf5 import opened, read_json, read_numbers, read_spectrum, write_spectrum

__all__ = ["load_hdf5", "plain", "require_slices_folder", "save_hdf5", "save_npy", "save_tiff"]

FORMAT = 1
JSON_PARTS = ("history", "plan", "counts", "settings")


def plain(value: Any) -> Any:
    """`value` in what JSON knows: NumPy numbers and arrays become Python's, NaN and infinity None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, (str, int, bool, type(None))) else str(value)


def save_hdf5(result: Result, path: str | os.PathLike, *, overwrite: bool = False) -> None:
    """See :meth:`Result.save`."""
    import h5py

    volume = result.volume[None, ::-1] if result.flipped_2d else result.volume
    arrays = [result.basis, volume, *result.gaussians.values()]
    needed = sum(np.asarray(array).nbytes for array in arrays)
    with (
        replacing(path, overwrite=overwrite, needed_bytes=needed) as temporary,
        h5py.File(temporary, "w") as file,
    ):
        file["implements"] = "exchange:polysplat"
        data = file.create_dataset("exchange/data", data=volume)
        size = result.grid.voxel_size
        data.attrs.update(
            description="attenuation",
            units=f"1/{result.unit}",
            unit=f"1/{result.unit}",
            axes="z:y:x",
            voxel_size=size,
            origin=result.grid.lower + size / 2,
        )
        if result.energy_kev is not None:
            data.attrs["energy_kev"] = result.energy_kev
        _write_model(file.create_group("polysplat"), result)


def _write_model(group: Any, result: Result) -> None:
    grid = result.grid
    group.attrs.update(format=FORMAT, unit=result.unit, seconds=result.seconds, flipped_2d=result.flipped_2d)
    group.attrs.update(lower=grid.lower, upper=grid.upper)
    if result.energy_kev is not None:
        group.attrs["energy_kev"] = result.energy_kev
    basis = group.create_dataset("basis", data=result.basis)
    basis.attrs["unit"] = "g/cm3" if result.materials is not None else f"1/{result.unit}"
    for name, values in result.gaussians.items():
        group[f"gaussians/{name}"] = values
    write_spectrum(group, result.spectrum)
    if result.materials is not None:
        group["materials"] = json.dumps(plain(list(result.materials)))
    for name in JSON_PARTS:
        group[name] = json.dumps(plain(getattr(result, name)))


def load_hdf5(path: str | os.PathLike) -> Result:
    """See :meth:`Result.load`."""
    with opened(Path(path)) as file:
        group = file.get("polysplat")
        if group is None or group.attrs.get("format") is None or "basis" not in group:
            raise fail("path", "a file written by Result.save", f"{path} without /polysplat/basis")
        if int(group.attrs["format"]) > FORMAT:
            raise fail(
                "path",
                f"a file of format {FORMAT}",
                f"format {group.attrs['format']}",
                "update tomo-polysplat",
            )
        basis = read_numbers(group, "basis")
        gaussians = {
            name: read_numbers(group, f"gaussians/{name}") for name in GAUSSIAN_PARTS if "gaussians" in group
        }
        materials = read_json(group, "materials", None)
        energy = group.attrs.get("energy_kev")
        return Result(
            basis=basis,
            grid=VolumeGrid(basis.shape[1:], group.attrs["lower"], group.attrs["upper"]),
            unit=str(group.attrs["unit"]),
            energy_kev=None if energy is None else float(energy),
            materials=None if materials is None else Materials(*materials),
            spectrum=read_spectrum(group),
            gaussians=gaussians,
            **{name: read_json(group, name, [] if name == "history" else {}) for name in JSON_PARTS},
            seconds=float(group.attrs["seconds"]),
            flipped_2d=bool(group.attrs["flipped_2d"]),
        )


def save_npy(result: Result, path: str | os.PathLike, *, overwrite: bool = False) -> None:
    """See :meth:`Result.save_npy`."""
    volume = result.volume
    with (
        replacing(path, overwrite=overwrite, needed_bytes=volume.nbytes) as temporary,
        open(temporary, "wb") as file,
    ):
        np.save(file, volume, allow_pickle=False)


def require_slices_folder(folder: str | os.PathLike, *, overwrite: bool) -> list[Path]:
    """The slices in a folder; refused are slices that must stay, and folders that cannot be written to."""
    target = Path(folder)
    if target.exists() and not target.is_dir():
        raise fail("folder", "a folder", f"the file {target}", error=NotADirectoryError)
    present = sorted(target.glob("slice_*.tif"))
    if present and not overwrite:
        raise fail(
            "folder",
            "one without slices",
            f"{len(present)} in {target}",
            "pass overwrite=True",
            FileExistsError,
        )
    require_writable(existing_parent(target))
    return present


def save_tiff(result: Result, folder: str | os.PathLike, *, overwrite: bool = False) -> None:
    """See :meth:`Result.save_tiff`."""
    import tifffile

    target = Path(folder)
    present = require_slices_folder(target, overwrite=overwrite)
    target.mkdir(parents=True, exist_ok=True)
    volume = result.volume.reshape(result.grid.shape)
    require_room(target, volume.nbytes)
    about = {
        "unit": f"1/{result.unit}",
        "energy_kev": result.energy_kev,
        "voxel_size": plain(result.grid.voxel_size),
        "first_row": "largest y" if result.flipped_2d else "smallest y",
    }
    written = set()
    for index, image in enumerate(volume):
        path = target / f"slice_{index:04d}.tif"
        with replacing(path, overwrite=True) as temporary:
            tifffile.imwrite(temporary, image, description=json.dumps(about), metadata=None)
        written.add(path)
    # Slices of an earlier, taller volume would otherwise be read as part of this one.
    for path in set(present) - written:
        path.unlink()
