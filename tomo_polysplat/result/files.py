"""Results in files.

The HDF5 file follows Data Exchange: ``/exchange/data`` (z, y, x) is the volume, with attributes ``unit``,
``energy_kev``, ``voxel_size`` and ``origin`` (x, y, z; the centre of the first voxel). What everything else
is computed from stands in ``/polysplat``: ``basis``, ``gaussians``, ``spectrum``, and as JSON text
``history``, ``plan``, ``counts``, ``settings``, ``provenance`` and ``materials``; ``residuals`` are those by view and
by pixel, where they are known. y ascends with the index, also
after a 2D scan.
"""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from tomo_polysplat.checks import fail, require_choice, require_number
from tomo_polysplat.files import replacing, write_text
from tomo_polysplat.parallel import kept_threads
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.plain_file import PlainFile
from tomo_polysplat.plan.answer import Answer
from tomo_polysplat.result.data import GAUSSIAN_PARTS, ResultData
from tomo_polysplat.result.image import Image
from tomo_polysplat.result.residuals_file import read_residuals, write_residuals
from tomo_polysplat.scan.geometry import VolumeGrid
from tomo_polysplat.scan.hdf5 import (
    find_array,
    find_group,
    number_attribute,
    opened,
    read_attribute,
    read_json,
    read_numbers,
    read_spectrum,
    text_attribute,
    write_spectrum,
)
from tomo_polysplat.scan.hdf5_links import member
from tomo_polysplat.scan.hdf5_map import is_mapped, mapped, read_or_map
from tomo_polysplat.scan.hdf5_writer import new_hdf5
from tomo_polysplat.units import LENGTH_UNITS

__all__ = ["load_hdf5", "plain", "save_hdf5", "write_json", "write_npy"]

Made = TypeVar("Made", bound=ResultData)

FORMAT = 1
# In any unit; squares of larger ones are beyond single precision.
_LARGEST = 1e15
# In g/cm3: forty times osmium.
_DENSEST = 1e3
_RANGES = {
    "position": (-_LARGEST, _LARGEST),
    "scale": (0.0, _LARGEST),
    "rotation": (-1.001, 1.001),
    "density": (-_LARGEST, _LARGEST),
    "u": (-0.2, 1.1),
}
# Numbers in a part of a Gaussian: its rotation has them.
_MOST_PARTS = 4
# Dimensions of what was taken out of the rays, and the largest logarithm of a gain.
_LIGHT, _STRONGEST = {"gains": 2, "drift": 1}, 1e3
JSON_PARTS = ("history", "plan", "counts", "settings", "provenance", "geometry")


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


def write_json(path: str | os.PathLike, content: Any, *, overwrite: bool) -> None:
    """Write `content` as JSON, made `plain`."""
    write_text(path, json.dumps(plain(content), indent=2) + "\n", overwrite=overwrite)


@kept_threads()
def save_hdf5(result: ResultData, path: str | os.PathLike, *, overwrite: bool = False) -> None:
    """See :meth:`Result.save`."""
    arrays = [result.basis, result.basis[0], *result.gaussians.values()]
    needed = sum(np.asarray(array).nbytes for array in arrays)
    with new_hdf5(path, overwrite=overwrite, needed_bytes=needed) as file:
        file["implements"] = "exchange:polysplat"
        data = file.create_dataset("exchange/data", result.grid.shape, np.float32)
        for slices, values in result.slabs():
            data[slices] = values
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


def _write_model(group: Any, result: ResultData) -> None:
    grid = result.grid
    group.attrs.update(format=FORMAT, unit=result.unit, seconds=result.seconds, flipped_2d=result.flipped_2d)
    group.attrs.update(lower=grid.lower, upper=grid.upper)
    if result.energy_kev is not None:
        group.attrs["energy_kev"] = result.energy_kev
    basis = group.create_dataset("basis", data=result.basis)
    basis.attrs["unit"] = "g/cm3" if result.materials is not None else f"1/{result.unit}"
    for name, values in result.gaussians.items():
        group[f"gaussians/{name}"] = values
    for name in _LIGHT:
        if (part := getattr(result, name)) is not None:
            group[name] = part
    write_spectrum(group, result.spectrum)
    if result.materials is not None:
        group["materials"] = json.dumps(plain(list(result.materials)))
    write_residuals(group, result.residuals)
    for name in JSON_PARTS:
        part = getattr(result, name)
        if name == "plan":
            part = {key: answer.to_dict() for key, answer in part.items()}
        group[name] = json.dumps(plain({} if part is None else part))


def load_hdf5(path: str | os.PathLike, make: type[Made]) -> Made:
    """See :meth:`Result.load`; `make` is the class to make of it."""
    with opened(Path(path)) as file:
        group = find_group(file, "polysplat")
        if group is None or number_attribute(group, "format") is None:
            remedy = "a scan is reconstructed first, by `tomo-polysplat recon SCAN -o RESULT.h5`"
            got = f"{path} without /polysplat and its format"
            raise fail("path", "a file written by Result.save", got, remedy)
        if (version := number_attribute(group, "format")) != FORMAT:
            raise fail("path", f"a file of format {FORMAT}", f"format {version:g}", "update tomo-polysplat")
        basis = read_or_map(group, "basis")
        if basis.ndim != 4:
            raise fail("/polysplat/basis", "shape (channels, z, y, x)", f"{basis.shape}")
        materials = _read_materials(group)
        limit = _LARGEST if materials is None else _DENSEST
        _require_range("basis", basis, -limit, limit)
        result = make(
            basis=basis,
            grid=VolumeGrid(basis.shape[1:], read_attribute(group, "lower"), read_attribute(group, "upper")),
            unit=require_choice("unit in the file", text_attribute(group, "unit"), LENGTH_UNITS),
            energy_kev=number_attribute(group, "energy_kev"),
            materials=materials,
            spectrum=read_spectrum(group),
            gaussians=_read_gaussians(group, planar=basis.shape[1] == 1),
            **_read_parts(group),
            **_read_light(group),
            seconds=require_number(
                "seconds in the file", number_attribute(group, "seconds") or 0.0, at_least=0
            ),
            flipped_2d=bool(number_attribute(group, "flipped_2d")),
            residuals=read_residuals(group),
        )
        _take_volume(result, file)
    return result


def _take_volume(result: ResultData, file: Any) -> None:
    """Map the volume of a result whose densities are mapped, instead of making it of these in memory."""
    if not is_mapped(result.basis) or result.flipped_2d:
        return
    volume = mapped(file, "exchange/data")
    if volume is not None and volume.shape == result.grid.shape:
        energy = number_attribute(member(file, "exchange/data"), "energy_kev")
        if energy == result.energy_kev:
            _require_range("volume", volume, -_LARGEST, _LARGEST)
            result.__dict__["volume"] = volume


def _read_gaussians(group: Any, planar: bool) -> dict[str, np.ndarray]:
    if find_group(group, "gaussians") is None:
        return {}
    density = find_array(group, "gaussians/density")
    most = _MOST_PARTS * (0 if density is None else density.size)
    parts = {name: read_numbers(group, f"gaussians/{name}", most=most) for name in GAUSSIAN_PARTS}
    for name, values in parts.items():
        # Those of a slice have no end along z.
        bounded = values[..., :2] if planar and name == "scale" else values
        _require_range(f"gaussians/{name}", bounded, *_RANGES[name])
    if planar:
        _require_range("gaussians/scale", parts["scale"], 0.0, math.inf)
    return parts


def _read_light(group: Any) -> dict[str, Any]:
    """Gains and drift that were taken out, where there are any."""
    found: dict[str, Any] = {}
    for name, dimensions in _LIGHT.items():
        if find_array(group, name) is not None:
            found[name] = read_numbers(group, name).astype(np.float32)
            if found[name].ndim != dimensions:
                raise fail(f"/polysplat/{name}", f"{dimensions} dimensions", f"{found[name].shape}")
            _require_range(name, found[name], -_STRONGEST, _STRONGEST)
    return found


def _require_range(name: str, values: np.ndarray, low: float, high: float) -> None:
    """Refuse what no fit makes, NaN and infinity first: one bit of a damaged file is enough for them."""
    # Both are NaN where any value is, and then no comparison holds.
    smallest, largest = (float(values.min()), float(values.max())) if values.size else (low, high)
    if not (smallest >= low and largest <= high):
        got = f"{smallest:g} to {largest:g}"
        wanted = f"finite numbers from {low:g} to {high:g}"
        raise fail(f"/polysplat/{name}", wanted, got, "the file is damaged: copy or write it again")


def _read_materials(group: Any) -> Materials | None:
    names = read_json(group, "materials", None)
    if names is None:
        return None
    if not isinstance(names, list) or len(names) != 3:
        raise fail("/polysplat/materials", "three materials", f"{names!r}"[:100])
    return Materials(*names)


def _read_parts(group: Any) -> dict[str, Any]:
    """History, plan and so on, of the types that a result has them in."""
    parts = {name: read_json(group, name, [] if name == "history" else {}) for name in JSON_PARTS}
    for name, content in parts.items():
        good = isinstance(content, list) if name == "history" else isinstance(content, dict)
        if good and name == "history":
            good = all(isinstance(record, dict) and _numeric(record) for record in content)
        if not good:
            raise fail(f"/polysplat/{name}", "what Result.save writes", f"{content!r}"[:100])
    parts["plan"] = _answers(parts["plan"])
    parts["geometry"] = _geometry(parts["geometry"])
    return parts


def _geometry(stored: dict[str, Any]) -> dict[str, Any] | None:
    """ASTRA's geometry of vectors; None where there is none."""
    if not stored:
        return None
    try:
        vectors = np.array(stored["Vectors"], np.float64)
        kind, rows, columns = stored["type"], int(stored["DetectorRowCount"]), int(stored["DetectorColCount"])
    except (KeyError, TypeError, ValueError) as error:
        raise fail("/polysplat/geometry", "what Result.save writes", f"{error}"[:100]) from error
    known = kind in ("cone_vec", "parallel3d_vec") and min(rows, columns) > 0
    if not known or vectors.ndim != 2 or vectors.shape[1:] != (12,) or not np.isfinite(vectors).all():
        raise fail("/polysplat/geometry", "what Result.save writes", f"{stored!r}"[:100])
    return {"type": kind, "DetectorRowCount": rows, "DetectorColCount": columns, "Vectors": vectors}


def _answers(plan: dict[str, Any]) -> dict[str, Answer]:
    try:
        return {name: Answer.from_dict(answer) for name, answer in plan.items()}
    except TypeError as error:
        raise fail("/polysplat/plan", "what Result.save writes", f"{error}"[:100]) from error


def _numeric(record: dict[str, Any]) -> bool:
    """Whether everything in a record of the history but the name of its stage is a number or missing."""
    numbers = (value for name, value in record.items() if name != "stage")
    return all(value is None or isinstance(value, (int, float)) for value in numbers)


def write_npy(image: Image, path: str | os.PathLike, *, overwrite: bool = False) -> None:
    """The numbers alone, as a NumPy array: (z, y, x), or (y, x) with row 0 at the largest y after a 2D scan."""
    values = np.ascontiguousarray(image.values[0, ::-1]) if image.top_row == "largest y" else image.values
    with (
        replacing(path, overwrite=overwrite, needed_bytes=values.nbytes) as temporary,
        PlainFile(temporary) as file,
    ):
        np.save(file, values, allow_pickle=False)
