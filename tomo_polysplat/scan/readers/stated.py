"""What a user says about a scan, as arguments or in a small TOML file beside the pictures."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tomo_polysplat.checks import did_you_mean, fail, require_array, require_choice, require_number
from tomo_polysplat.physics.filter_text import require_filters
from tomo_polysplat.scan.readers.acquisition import Acquisition, Guess, Setup, Tube
from tomo_polysplat.scan.readers.angle_text import angles_in, require_degrees
from tomo_polysplat.scan.readers.picture_files import frames_of
from tomo_polysplat.scan.readers.picture_names import named_files
from tomo_polysplat.scan.readers.text import text_of
from tomo_polysplat.scan.reading import INPUT_KINDS, ReadOptions
from tomo_polysplat.units import LENGTH_UNITS

__all__ = [
    *("KEYS", "read_toml", "require_known", "require_no_slips", "stated_over", "view_degrees"),
    "with_options",
]

# Lengths are in `unit`; `arc` and `degrees` count counterclockwise seen from above, of the source about the object.
KEYS = {
    "projections": "TIFF, .npy or EDF files: a folder, a file of many pictures, or a pattern such as proj_*.tif",
    "flats": "pictures without the object",
    "darks": "pictures without light",
    "unit": "of the lengths: mm (default), cm, um, m",
    "source_object": "from the source to the rotation axis",
    "source_detector": "from the source to the detector",
    "pixel": "side of a detector pixel, or [width, height]",
    "offset": "[right, up] of the detector's middle from the foot of the ray through the axis",
    "roll": "degrees by which the detector is turned counterclockwise",
    "degrees": "angles of all views, or the name of a text file with one a line",
    "arc": "degrees from the first view to one step after the last",
    "beam": "cone (default) or parallel",
    "first_row": "top (default) or bottom",
    "seen_from": "source (default) or detector: where one looks from who sees the pictures as they are",
    "input": "counts (default), transmission or attenuation",
    "white": "counts of the open beam where there are no flats",
    "kvp": "tube voltage in kV",
    "anode": "W (default), Mo, Rh, Ag, Cu or Au",
    "filter": "such as Al 1mm, or none",
    "detector": "such as csi:0.6mm, gos:0.2mm, cdte:1mm or counting",
    "exposure": "seconds a picture",
    "name": "of the scan",
}
_OTHER_NAMES = {
    "sod": "source_object",
    "sdd": "source_detector",
    "flat": "flats",
    "dark": "darks",
    "angles": "degrees",
    "voltage": "kvp",
}
_MOST_BYTES = 1 << 20
# Likeness (difflib's, of 1) from which a key is a slip of one of ours: `filters` has 0.92, `operator` below 0.6.
_SLIP = 0.8


def read_toml(path: Path) -> dict[str, Any]:
    """The keys of a TOML file.

    Raises
    ------
    ValueError
        If it is none, or large.
    """
    text = text_of(path, _MOST_BYTES).replace("\r\n", "\n")
    try:
        if sys.version_info >= (3, 11):
            import tomllib
        else:
            import tomli as tomllib
        return tomllib.loads(text)
    except ImportError as error:
        raise fail("path", "tomli, which reads TOML on Python 3.10", "none", "pip install tomli") from error
    except (ValueError, RecursionError) as error:
        remedy = "numbers have a decimal point (0.1), texts stand in quotes, one key a line"
        raise fail("path", "a TOML file", f"{path} ({error})", remedy) from error


def require_known(stated: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Stated values under their usual names; refuses names that are not known."""
    known = {_OTHER_NAMES.get(key, key): value for key, value in stated.items() if value is not None}
    for key in known:
        if key not in KEYS:
            meant = did_you_mean(key, [*KEYS, *_OTHER_NAMES])
            raise fail(where, f"names among {', '.join(KEYS)}", repr(key), meant)
    return known


def require_no_slips(others: Iterable[str], where: str) -> None:
    """Refuse a name that is nearly one of ours: what it says would be kept as a note, and not done.

    Raises
    ------
    ValueError
        For such a name.
    """
    names = [*KEYS, *_OTHER_NAMES]
    for key in others:
        if difflib.get_close_matches(key.lower().replace("-", "_").replace(" ", "_"), names, 1, _SLIP):
            raise fail(
                where, "keys that are known, or none of their like", repr(key), did_you_mean(key, names)
            )


def with_options(stated: Mapping[str, Any], options: ReadOptions) -> dict[str, Any]:
    """What a user states, with the arguments of `tomo_polysplat.load_scan` that say the same."""
    known = require_known(stated, "scanner")
    said = {
        "unit": options.unit,
        "degrees": options.theta,
        "pixel": options.pixel_size,
        "input": options.input,
    }
    for key, value in said.items():
        if value is not None:
            known.setdefault(key, value)
    if options.centre is not None:
        remedy = "pass scanner={'offset': (right, up)}, the detector's middle from the axis' shadow"
        raise fail("centre", "None for pictures", f"{options.centre:g}", remedy)
    return known


def stated_over(told: Acquisition, stated: Mapping[str, Any], folder: Path) -> Acquisition:
    """What a reader was told, with what the user states put in its place."""
    tube = Tube(
        _number(stated, "kvp", told.tube.kvp),
        told.tube.filters if "filter" not in stated else require_filters("filter", str(stated["filter"])),
        stated.get("anode", told.tube.anode),
        stated.get("detector", told.tube.detector),
    )
    if isinstance(told.setup, Setup):
        told = replace(told, setup=_setup(told.setup, stated, folder, told.frames.shape[0]))
    elif given := {"source_object", "source_detector", "pixel", "offset", "degrees", "arc"} & stated.keys():
        raise fail(sorted(given)[0], "nothing, as the file has the geometry of each view", "a value")
    for name in ("flats", "darks"):
        if name in stated:
            told = replace(told, **{name: frames_of(named_files(folder, stated[name], name))})  # type: ignore[arg-type]
    return replace(
        told,
        # A monitor compares views with the flats beside them.
        light=None if "flats" in stated else told.light,
        said=tuple(
            words for words in told.said if not (isinstance(words, Guess) and stated.keys() & words.unless)
        ),
        tube=tube,
        name=str(stated.get("name", told.name)),
        unit=require_choice("unit", stated.get("unit", told.unit), LENGTH_UNITS),
        input=require_choice("input", stated.get("input", told.input), INPUT_KINDS),
        white=_number(stated, "white", told.white),
        exposure=_number(stated, "exposure", told.exposure),
        top_first=_one_of(stated, "first_row", ("bottom", "top"), told.top_first),
        from_detector=_one_of(stated, "seen_from", ("source", "detector"), told.from_detector),
    )


def _setup(setup: Setup, stated: Mapping[str, Any], folder: Path, views: int) -> Setup:
    distances: dict[str, Any] = {
        name: _number(stated, name, getattr(setup, name)) for name in ("source_object", "source_detector")
    }
    if stated.get("beam", "cone") != "cone":
        require_choice("beam", stated["beam"], ("cone", "parallel"))
        distances = dict.fromkeys(distances)
    angles = view_degrees(stated, folder, views)
    return replace(
        setup,
        **distances,
        degrees=setup.degrees if angles is None else angles,
        pixel=stated.get("pixel", setup.pixel),
        offset=stated.get("offset", setup.offset),
        roll=_number(stated, "roll", setup.roll),
    )


def view_degrees(stated: Mapping[str, Any], folder: Path, views: int) -> np.ndarray | None:
    """The stated angles of so many views, or None."""
    if "degrees" in stated and "arc" in stated:
        raise fail("degrees, arc", "one of the two", "both")
    if "arc" in stated:
        return require_degrees(np.arange(views) * (require_number("arc", stated["arc"]) / views), "arc")
    if "degrees" not in stated:
        return None
    given = stated["degrees"]
    if isinstance(given, (str, Path)):
        given = _angle_file(given, folder)
    angles = require_array("degrees", given, 1).astype(np.float64)
    if len(angles) != views:
        remedy = "name the angles of this scan, or say how far it turned: arc (--angles 360)"
        raise fail("degrees", f"one angle for each of {views} pictures", f"{len(angles)}", remedy)
    return require_degrees(angles)


def _angle_file(name: str | Path, folder: Path) -> np.ndarray:
    path = folder / name if (folder / name).is_file() else Path(name)
    try:
        return angles_in(text_of(path, _MOST_BYTES, "degrees"))
    except ValueError as error:
        raise fail("degrees", "a text file with one angle a line", f"{path} ({error})") from None


def _number(stated: Mapping[str, Any], key: str, otherwise: Any) -> Any:
    return require_number(key, stated[key]) if key in stated else otherwise


def _one_of(stated: Mapping[str, Any], key: str, words: tuple[str, str], otherwise: bool) -> bool:
    """Whether the second of two words is stated."""
    return words.index(require_choice(key, stated[key], words)) == 1 if key in stated else otherwise
