"""NXtomo: an HDF5 file of NeXus' in which ``image_key`` tells projections from flats and darks.

Rows are taken to begin at the top, pictures to be as seen from the source, and ``rotation_angle`` to count as ASTRA's
angles do. Flips that the file tells of (``detector/transformations``, in older files ``x_flipped``, ``y_flipped``)
are undone, as the ESRF's own programs undo them: half a turn about the vertical exchanges left and right, half a turn
about another axis top and bottom.

What Diamond's program for data acquisition writes is read as well: there the detector has a name of its own, and the
angles stand in the group of that name beside the pictures. Positions that were measured come before those asked for.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.scan.hdf5 import (
    find_array,
    is_in_radians,
    opened,
    read_attribute,
    read_numbers,
    read_text,
    text_attribute,
)
from tomo_polysplat.scan.readers.acquisition import Acquisition, Guess, Setup
from tomo_polysplat.scan.readers.files_of_scans import hdf5_files, the_one
from tomo_polysplat.scan.readers.frames import Hdf5Frames
from tomo_polysplat.scan.readers.nxtomo_entry import (
    CONTROL,
    KEYS,
    detector_of,
    entries_with_pictures,
    entry_of,
    group_of,
    names_in,
)
from tomo_polysplat.scan.readers.stated import require_known, stated_over

if TYPE_CHECKING:
    import h5py

    from tomo_polysplat.scan.hdf5_array import StoredArray

__all__ = ["KIND", "read", "recognises"]

KIND = "NXtomo (HDF5)"
_SUFFIXES = (".nx", ".nxs", ".h5", ".hdf5", ".hdf")
_PROJECTION, _FLAT, _DARK, _WAY_BACK = 0, 1, 2, -1
# Counts of the beam in each picture, and the share by which they may change and say nothing.
_MONITOR, _STEADY = "control/data", 1e-3
_SOURCE = "instrument/source/distance"
# Names of turns among Diamond's motors, and how those of positions that were asked for end.
_ANGLE, _ASKED_FOR = re.compile("rot|theta|angle"), "_set"
_MM = {"m": 1e3, "cm": 10.0, "mm": 1.0, "um": 1e-3, "micron": 1e-3, "meter": 1e3, "metre": 1e3}
# A source so many times as far from the object as the detector is sends a parallel beam.
_FAR = 200.0
# Degrees by which a turn may miss half of one; the ESRF's vertical where no gravity is told.
_HALF_TURN, _UP = 1.0, (0.0, 0.0, 1.0)
_MOST_TURNS = 20


def recognises(path: Path) -> bool:
    """Whether it is such a file or a folder with one."""
    return bool(_files(path))


def read(path: Path, stated: Mapping[str, Any]) -> Acquisition:
    """See `tomo_polysplat.load_scan`; `stated` has its ``scanner``."""
    file_of_scan = the_one(_files(path))
    with opened(file_of_scan) as file:
        entry = entry_of(file)
        assert entry is not None  # it was recognised by that
        told = _told(file_of_scan, entry)
        entries, read = entries_with_pictures(file), entry.name.split("/")[1]
    if len(entries) > 1:
        others = ", ".join(name for name in entries if name != read)
        told = told.saying(
            f"the entry {read} is read; others of the file ({others[:200]}) want a file of their own"
        )
    return stated_over(told, require_known(stated, "scanner"), file_of_scan.parent)


def _files(path: Path) -> list[Path]:
    return hdf5_files(path, _SUFFIXES, lambda file: entry_of(file) is not None)


def _told(path: Path, entry: h5py.Group) -> Acquisition:
    detector = detector_of(entry)
    assert detector is not None  # it was recognised by that
    data = find_array(entry, f"{detector}/data")
    if data is None or data.ndim != 3:
        got = "none" if data is None else f"shape {data.shape}"
        raise fail("path", f"pictures in {detector}/data, (pictures, rows, columns)", got)
    name = next(key for key in KEYS if find_array(entry, f"{detector}/{key}") is not None)
    keys = read_numbers(entry, f"{detector}/{name}", (len(data),))
    keys, said = _without_way_back(entry, detector, keys)
    angles = _degrees(entry, detector, len(data))
    frames = {key: np.flatnonzero(keys == key) for key in (_PROJECTION, _FLAT, _DARK)}
    if not len(frames[_PROJECTION]):
        raise fail(
            "path", "pictures of image_key 0, the projections", f"keys {sorted(set(keys.tolist()))}"[:200]
        )
    stacks = {key: Hdf5Frames(data, chosen) for key, chosen in frames.items() if len(chosen)}
    setup, unit, more = _setup(entry, detector, angles[frames[_PROJECTION]], data.shape[2])
    told = Acquisition(
        KIND,
        stacks[_PROJECTION],
        setup,
        name=read_text(entry, "sample/name") or path.stem,
        unit=unit,
        flats=stacks.get(_FLAT),
        darks=stacks.get(_DARK),
        light=_light(entry, frames, len(data)),
        exposure=_first(entry, f"{detector}/count_time"),
        other=_others(entry, detector),
    )
    if _DARK not in stacks:
        said.append(
            Guess("no dark pictures: without light a pixel is taken to count 0; give darks=", "darks")
        )
    if told.light is not None:
        ends = f"{told.light.min():.3g} to {told.light.max():.3g}"
        monitor = (
            f"the light of the views is taken to be {ends} times that of the flats, as control/data counts it"
        )
        said.append(Guess(monitor, "flats"))
    return _unflipped(told.saying(*said, *more), entry, detector)


def _without_way_back(entry: h5py.Group, detector: str, keys: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Keys of which pictures for alignment, taken on the way back, have none of ours; and what to say of them."""
    if not _is_there(entry, f"{detector}/{CONTROL}", len(keys)):
        return keys, []
    control = read_numbers(entry, f"{detector}/{CONTROL}", (len(keys),))
    back = (control == _WAY_BACK) & (keys == _PROJECTION)
    if not back.any():
        return keys, []
    words = f"{np.count_nonzero(back)} pictures of the way back ({CONTROL} {_WAY_BACK}) are left out"
    return np.where(back, _WAY_BACK, keys), [words]


def _light(entry: h5py.Group, frames: Mapping[int, np.ndarray], pictures: int) -> np.ndarray | None:
    """The beam in each view over that in the flats, by the monitor's counts; None where they tell of no change."""
    if not len(frames[_FLAT]) or not _is_there(entry, _MONITOR, pictures):
        return None
    counts = read_numbers(entry, _MONITOR, (pictures,)).astype(np.float64)
    used = counts[np.concatenate([frames[_PROJECTION], frames[_FLAT]])]
    if not (np.isfinite(used).all() and (used > 0).all()):
        return None
    light = counts[frames[_PROJECTION]] / counts[frames[_FLAT]].mean()
    return light if np.abs(light - 1).max() > _STEADY else None


def _degrees(entry: h5py.Group, detector: str, pictures: int) -> np.ndarray:
    """Of all pictures."""
    names = ["sample/rotation_angle", "data/rotation_angle"]
    name = detector.rpartition("/")[2]
    inside = sorted(names_in(group_of(entry, name)), key=lambda axis: axis.endswith(_ASKED_FOR))
    names += [f"{name}/{axis}" for axis in inside if _ANGLE.search(axis)]
    name = next((name for name in names if _is_there(entry, name, pictures)), names[0])
    angles = read_numbers(entry, name, (pictures,)).astype(np.float64)
    dataset = find_array(entry, name)
    if dataset is not None and is_in_radians(dataset):
        angles = np.rad2deg(angles)
    return angles


def _is_there(entry: h5py.Group, name: str, pictures: int) -> bool:
    """Whether there are so many numbers; a file that a link leads to may be missing."""
    with suppress(ValueError):
        found = find_array(entry, name)
        return found is not None and found.shape == (pictures,)
    return False


def _unflipped(told: Acquisition, entry: h5py.Group, detector: str) -> Acquisition:
    """With what the file tells of exchanged sides; the axis is that of the pictures as they are stored."""
    sideways, upside_down = _flips(entry, detector)
    setup = told.setup
    if not (sideways or upside_down) or not isinstance(setup, Setup):
        return told
    if sideways:
        setup = replace(setup, offset=(-setup.offset[0], setup.offset[1]))
    ways = " and ".join(["left and right"] * sideways + ["top and bottom"] * upside_down)
    words = f"the file says that {ways} are exchanged, which is undone; the axis is that of its pictures"
    return replace(told, setup=setup, top_first=not upside_down, from_detector=sideways).saying(words)


def _flips(entry: h5py.Group, detector: str) -> tuple[bool, bool]:
    """Whether left and right, and top and bottom, are exchanged."""
    old = (_first(entry, f"{detector}/{axis}_flipped") for axis in "xy")
    sideways, upside_down = (bool(value) for value in old)
    turns = group_of(entry, f"{detector}/transformations")
    if turns is None:
        return sideways, upside_down
    about = {name: _axis(turns, name) for name in list(turns)[:_MOST_TURNS]}
    gravity = about.pop("gravity", None)
    up = np.abs(_UP if gravity is None else gravity)
    for name, axis in about.items():
        if axis is not None and abs(abs(_first(turns, name) or 0.0) - 180) < _HALF_TURN:
            vertical = bool(np.abs(axis) @ up > 0.5 * np.linalg.norm(axis) * np.linalg.norm(up))
            sideways, upside_down = sideways ^ vertical, upside_down ^ (not vertical)
    return sideways, upside_down


def _axis(turns: h5py.Group, name: str) -> np.ndarray | None:
    """Of a rotation, or the direction of gravity."""
    dataset = find_array(turns, name)
    kind = "" if dataset is None else text_attribute(dataset, "transformation_type")
    if kind not in ("rotation", "gravity"):
        return None
    vector = np.asarray(read_attribute(dataset, "vector"))
    told = vector.dtype.kind in "fiu" and vector.shape == (3,) and vector.any() and np.isfinite(vector).all()
    return vector.astype(np.float64) if told else None


def _axis_column(entry: h5py.Group, detector: str, columns: int) -> tuple[float | None, list[str]]:
    """Columns by which the axis is to the right of the middle.

    Files of the ESRF count from the middle, others from the first column; a full view has its axis near the middle.
    """
    told = _first(entry, f"{detector}/x_rotation_axis_pixel_position")
    half = (read_text(entry, f"{detector}/field_of_view") or "").lower() == "half"
    if told is None or told <= columns / (2 if half else 4):
        return told, []
    shift = told - (columns - 1) / 2
    return shift, [
        f"the axis at column {told:g} is taken to be counted from the first: {shift:g} from the middle"
    ]


def _setup(
    entry: h5py.Group, detector: str, degrees: np.ndarray, columns: int
) -> tuple[Setup, str, list[str]]:
    sides = [_length(entry, f"{detector}/{axis}_pixel_size") for axis in "xy"]
    behind, before = _length(entry, f"{detector}/distance"), _length(entry, _SOURCE)
    width, height = (side or sides[1 - k] or 0.0 for k, side in enumerate(sides))
    said: list[str] = []
    unit = "mm"
    if not width:
        width = height = 1.0
        unit, before = "pixel", None
        said.append(Guess("the pixel is not known: lengths are in pixels; give pixel=", "pixel"))
    shift, counted = _axis_column(entry, detector, columns)
    said += counted
    if shift is None:
        axis = "the axis is taken to fall on the detector's middle; give offset= if it does not"
        said.append(Guess(axis, "offset"))
    setup = Setup(degrees, (width, height), offset=(-(shift or 0.0) * width, 0.0))
    if not before or not behind or before > _FAR * behind:
        parallel = "the beam is taken to be parallel; give source_object= and source_detector= if it is not"
        said.append(Guess(parallel, "beam", "source_object", "source_detector"))
        return setup, unit, said
    return replace(setup, source_object=before, source_detector=before + behind), unit, said


def _length(entry: h5py.Group, name: str) -> float | None:
    """In mm; positions before the object are negative in some files."""
    value, dataset = _first(entry, name), _scalar(entry, name)
    if value is None or dataset is None:
        return None
    unit = (text_attribute(dataset, "units") or "m").lower()
    if unit not in _MM:
        raise fail(f"units of {name}", f"one of {', '.join(_MM)}", repr(unit))
    return abs(value) * _MM[unit]


def _scalar(entry: h5py.Group, name: str) -> StoredArray | None:
    """What may be there; where nothing was known, some programs link to a text."""
    with suppress(ValueError):
        dataset = find_array(entry, name)
        return None if dataset is None or not dataset.size else dataset
    return None


def _first(entry: h5py.Group, name: str) -> float | None:
    dataset = _scalar(entry, name)
    if dataset is None:
        return None
    value = float(np.asarray(dataset[()]).reshape(-1)[0])
    return value if np.isfinite(value) else None


def _others(entry: h5py.Group, detector: str) -> dict[str, str]:
    """Texts that somebody may want to see again."""
    names = ("title", "start_time", "end_time", "instrument/name", f"{detector}/field_of_view")
    texts = {name: read_text(entry, name) for name in names}
    energy = _first(entry, "instrument/beam/incident_energy") or _first(entry, "beam/incident_energy")
    if energy is not None:
        texts["incident_energy"] = f"{energy:g}"
    return {name: text for name, text in texts.items() if text}
