"""Where an NXtomo file, or one of Diamond's, has its pictures, and keys that tell projections from flats and darks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import TYPE_CHECKING

from tomo_polysplat.scan.hdf5 import find_array, find_group

if TYPE_CHECKING:
    import h5py

__all__ = ["CONTROL", "KEYS", "detector_of", "entries_with_pictures", "entry_of", "group_of", "names_in"]

CONTROL = "image_key_control"
KEYS = ("image_key", CONTROL)
_USUAL = "detector"
_MOST_ENTRIES = 100


def entry_of(file: h5py.File) -> h5py.Group | None:
    """The first group with pictures and their keys, which may be one of an entry's; NXtomo's comes before Diamond's."""
    found = None
    for group, inner in _groups(file):
        detector = _detector_within(group) if inner else detector_of(group)
        if detector is not None and detector.endswith(f"/{_USUAL}"):
            return group
        found = group if found is None and detector is not None else found
    return found


def entries_with_pictures(file: h5py.File) -> list[str]:
    """Names of the entries that have pictures and their keys, or have a group that has."""
    found = (group.name.split("/")[1] for group, _ in _groups(file) if _detector_within(group) is not None)
    return list(dict.fromkeys(found))


def _detector_within(group: h5py.Group) -> str | None:
    with suppress(ValueError):  # what is no entry may hold anything
        return detector_of(group)
    return None


def _groups(file: h5py.File) -> Iterator[tuple[h5py.Group, bool]]:
    """All entries, each before those in it, and whether it is in another."""
    for name in list(file)[:_MOST_ENTRIES]:
        entry = group_of(file, name)
        if entry is None:
            continue
        yield entry, False
        for inner in list(entry)[:_MOST_ENTRIES]:
            group = group_of(entry, inner)
            if group is not None:
                yield group, True


def detector_of(entry: h5py.Group) -> str | None:
    """Path of the detector with keys, which mostly is called so; of several the first whose pictures are there."""
    inside = group_of(entry, "instrument")
    names = names_in(inside)
    usual_first = [_USUAL] * (_USUAL in names) + [name for name in names if name != _USUAL]
    keyed = [f"instrument/{name}" for name in usual_first if _has_keys(inside, name)]
    return next((path for path in keyed if _has_pictures(entry, path)), keyed[0] if keyed else None)


def _has_keys(instrument: h5py.Group | None, name: str) -> bool:
    group = None if instrument is None else group_of(instrument, name)
    if group is None:
        return False
    if name == _USUAL:
        return any(find_array(group, key) is not None for key in KEYS)
    with suppress(ValueError):  # what is no detector may hold anything
        return "data" in group and any(find_array(group, key) is not None for key in KEYS)
    return False


def _has_pictures(entry: h5py.Group, detector: str) -> bool:
    with suppress(ValueError):  # a link may lead to a file that is not there
        data = find_array(entry, f"{detector}/data")
        return data is not None and data.ndim == 3
    return False


def group_of(parent: h5py.Group, name: str) -> h5py.Group | None:
    """The group of that name, or None where there is something else."""
    try:
        return find_group(parent, name)
    except ValueError:
        return None


def names_in(group: h5py.Group | None) -> list[str]:
    """What is in it; h5py has bytes for names that are no texts."""
    return [name for name in list(group or ())[:_MOST_ENTRIES] if isinstance(name, str)]
