"""NeXus as the Core Imaging Library writes it: acquisition data with source, detector, axis and angles.

In its frame z is up and y runs from the source to the detector. View by view, source and detector are turned about the
axis by minus (initial angle + angle). This follows its documentation of ``AcquisitionGeometry`` and its writer.

Before version 20.11 it wrote two distances, the pixel and the angles alone, without their unit, and handed all of
that to ASTRA as it was: angles count as ASTRA's, and the first row is the lowest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.scan.geometry import Geometry
from tomo_polysplat.scan.hdf5 import (
    find_array,
    find_group,
    number_attribute,
    opened,
    read_numbers,
    text_attribute,
)
from tomo_polysplat.scan.readers.acquisition import Acquisition, Setup
from tomo_polysplat.scan.readers.files_of_scans import hdf5_files, the_one
from tomo_polysplat.scan.readers.frames import Hdf5Array
from tomo_polysplat.scan.readers.stated import require_known, stated_over

if TYPE_CHECKING:
    import h5py

    from tomo_polysplat.scan.hdf5_array import StoredArray

__all__ = ["KIND", "read", "recognises"]

KIND = "NeXus of the Core Imaging Library"
_SUFFIXES = (".nxs", ".nex", ".h5", ".hdf5")
_ENTRY = "entry1/tomo_entry"
_AXES = ("angle", "vertical", "horizontal")
# So few views may lie within a few degrees.
_FEW = 12


class _Frames:
    """Pictures of a dataset whose axes come in any order; reads what is asked for."""

    def __init__(
        self, found: StoredArray, labels: tuple[str, ...], packing: tuple[float, float] | None
    ) -> None:
        self._array, self._labels, self._packing = Hdf5Array(found), labels, packing
        opened = self._array.opened()
        sizes = dict(zip(labels, opened.shape))
        self.shape = (sizes["angle"], sizes.get("vertical", 1), sizes["horizontal"])
        self.dtype = np.dtype(np.float32) if packing else np.dtype(opened.dtype)

    def read(self, index: int, rows: slice, columns: slice) -> np.ndarray:
        """Part of one picture."""
        where: dict[str, Any] = {"angle": index, "vertical": rows, "horizontal": columns}
        part = self._array.read(tuple(where[label] for label in self._labels))
        left = [label for label in self._labels if label != "angle"]
        picture = part[None] if len(left) == 1 else part if left[0] == "vertical" else part.T
        if self._packing is None:
            return picture
        scale, offset = self._packing
        return ((picture.astype(np.float64) - offset) / scale).astype(np.float32)


def recognises(path: Path) -> bool:
    """Whether it is such a file or a folder with one."""
    return bool(_files(path))


def read(path: Path, stated: Mapping[str, Any]) -> Acquisition:
    """See `tomo_polysplat.load_scan`; `stated` has its ``scanner``."""
    file_of_scan = the_one(_files(path))
    known = require_known(stated, "scanner")
    with opened(file_of_scan) as file:
        entry = find_group(file, _ENTRY)
        assert entry is not None  # it was recognised by that
        told = _told(file_of_scan, entry)
    if "input" not in known:
        told = told.saying("the numbers are taken to be line integrals; give input= if they are not")
    if isinstance(told.setup, Setup):
        told = _as_before(told)
    if "unit" not in known:
        told = told.saying("the file states no unit of length: mm is taken; give unit=")
    return stated_over(told, known, file_of_scan.parent)


def _files(path: Path) -> list[Path]:
    return hdf5_files(path, _SUFFIXES, _is_cil)


def _is_cil(file: h5py.File) -> bool:
    try:
        entry = find_group(file, _ENTRY)
        return entry is not None and (find_group(entry, "config") is not None or _is_older(entry))
    except ValueError:
        return False


def _is_older(entry: h5py.Group) -> bool:
    data = find_array(entry, "data/data")
    return data is not None and text_attribute(data, "data_type") == "AcquisitionData"


def _told(path: Path, entry: h5py.Group) -> Acquisition:
    data = find_array(entry, "data/data")
    if data is None:
        raise fail("path", f"pictures in {_ENTRY}/data/data", f"none in {path}")
    # Where labels are members of an enumeration, some Pythons write its name before theirs.
    labels = tuple(_label(text_attribute(data, f"dim{k}") or "?") for k in range(data.ndim))
    if set(labels) not in ({"angle", "horizontal"}, set(_AXES)) or len(set(labels)) != len(labels):
        raise fail("dim0, dim1, ...", f"the axes {', '.join(_AXES)}", ", ".join(labels), "select one channel")
    scale, offset = number_attribute(data, "scale"), number_attribute(data, "offset")
    frames = _Frames(data, labels, (scale, offset) if scale and offset is not None else None)
    panel = text_attribute(data, "panel_origin") or "bottom-left"
    width = number_attribute(data, "pixel_size_h")
    height = number_attribute(data, "pixel_size_v") or width
    if not width or not height:
        raise fail("pixel_size_h", "the width of a pixel", f"none in {path}")
    return Acquisition(
        KIND,
        frames,
        _setup(entry, data, frames.shape[0], (width, height))
        if find_group(entry, "config") is None
        else _geometry(entry, frames.shape, (width, height)),
        name=path.stem,
        input="attenuation",
        top_first="top" in panel,
        from_detector="right" in panel,
    )


def _setup(entry: h5py.Group, data: StoredArray, views: int, pixel: tuple[float, float]) -> Setup:
    """Of an older file."""
    angles = read_numbers(entry, "data/rotation_angle", (views,)).astype(np.float64)
    if text_attribute(data, "geom_type") != "cone":
        return Setup(angles, pixel)
    before, behind = (number_attribute(data, f"dist_{part}") for part in ("source_center", "center_detector"))
    if not before or behind is None:
        raise fail("path", "dist_source_center and dist_center_detector of a cone beam", "not both")
    return Setup(angles, pixel, before, before + behind)


def _as_before(told: Acquisition) -> Acquisition:
    """An older file's angles, which are in radians where all of them make one turn at most."""
    setup = told.setup
    assert isinstance(setup, Setup)
    said = "the axis is taken to fall on the detector's middle; give offset= if it does not"
    if len(setup.degrees) < _FEW or np.ptp(setup.degrees) > 2 * np.pi:
        return told.saying(said)
    turned = replace(setup, degrees=np.rad2deg(setup.degrees))
    return replace(told, setup=turned).saying(
        f"the angles, which span {np.ptp(setup.degrees):.3g}, are taken for radians; give degrees= if they are not",
        said,
    )


def _geometry(entry: h5py.Group, shape: tuple[int, int, int], pixel: tuple[float, float]) -> Geometry:
    views, rows, columns = shape
    cone = find_array(entry, "config/source/position") is not None
    axis = _vector(entry, "rotation_axis/position", (0.0, 0.0, 0.0))
    upright = _upright(_vector(entry, "rotation_axis/direction", (0.0, 0.0, 1.0)))
    ray = _vector(entry, "source/position") - axis if cone else _vector(entry, "ray/direction")
    u = pixel[0] * _unit(_vector(entry, "detector/direction_x"))
    v = pixel[1] * _unit(_vector(entry, "detector/direction_y", (0.0, 0.0, 1.0)))
    corner = _vector(entry, "detector/position") - axis - 0.5 * (columns - 1) * u - 0.5 * (rows - 1) * v
    turned = (
        np.einsum("vij,j->vi", _turns(entry, views), upright @ vector) for vector in (ray, corner, u, v)
    )
    origins, corners, us, vs = turned
    return Geometry("cone" if cone else "parallel", origins, corners, us, vs, rows, columns)


def _label(text: str) -> str:
    return text.rpartition(".")[2].lower()


def _turns(entry: h5py.Group, views: int) -> np.ndarray:
    """Of source and detector about z, (views, 3, 3)."""
    angles = read_numbers(entry, "config/angles", (views,)).astype(np.float64)
    dataset = find_array(entry, "config/angles")
    assert dataset is not None  # it was just read
    angles = -(angles + (number_attribute(dataset, "initial_angle") or 0.0))
    if not _label(text_attribute(dataset, "angle_unit") or "degree").startswith("rad"):
        angles = np.deg2rad(angles)
    turns = np.zeros((views, 3, 3))
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(angles)
    turns[:, 1, 0], turns[:, 0, 1] = np.sin(angles), -np.sin(angles)
    turns[:, 2, 2] = 1.0
    return turns


def _vector(entry: h5py.Group, name: str, otherwise: tuple[float, float, float] | None = None) -> np.ndarray:
    """Three numbers of the configuration; of a scan of one plane the third is 0."""
    if find_array(entry, f"config/{name}") is None and otherwise is not None:
        return np.array(otherwise)
    found = read_numbers(entry, f"config/{name}", most=3).astype(np.float64).reshape(-1)
    if len(found) not in (2, 3):
        raise fail(f"config/{name}", "three numbers", f"{len(found)}")
    return np.append(found, np.zeros(3 - len(found)))


def _unit(vector: np.ndarray) -> np.ndarray:
    length = float(np.linalg.norm(vector))
    if not length > 0:
        raise fail("path", "directions of some length", "0")
    return vector / length


def _upright(axis: np.ndarray) -> np.ndarray:
    """The shortest turn that brings the rotation axis onto z (3, 3)."""
    x, y, cosine = _unit(axis)
    if cosine < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + cosine)
