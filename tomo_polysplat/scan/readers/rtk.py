"""RTK (Reconstruction Toolkit): a geometry of each view in XML, and the projections in one MetaImage or TIFF.

RTK turns about y; its x, y and z are our x, z and -y. In a view the world is turned by the gantry's angle about y, then
out of the plane about x, then in the plane about z, all negative; there the source is at (source offsets, distance) and
a pixel at its own place in mm plus the projection's offsets (RTK's documentation, "RTK 3D circular projection
geometry").
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from tomo_polysplat.checks import fail, require_number
from tomo_polysplat.files import file_content
from tomo_polysplat.scan.geometry import Geometry
from tomo_polysplat.scan.readers.acquisition import Acquisition
from tomo_polysplat.scan.readers.entries import entries_of
from tomo_polysplat.scan.readers.files_of_scans import the_one
from tomo_polysplat.scan.readers.frames import Frames, TiffFrames
from tomo_polysplat.scan.readers.metaimage import METAIMAGE_SUFFIXES, MetaImageFrames
from tomo_polysplat.scan.readers.picture_names import has_word, named_files, tiffs_in
from tomo_polysplat.scan.readers.stated import require_known, stated_over

__all__ = ["KIND", "read", "recognises"]

KIND = "RTK geometry (.xml)"
_MOST_BYTES = 1 << 27
_ANGLES = ("GantryAngle", "OutOfPlaneAngle", "InPlaneAngle")
_LENGTHS = (
    *("SourceToIsocenterDistance", "SourceToDetectorDistance", "SourceOffsetX", "SourceOffsetY"),
    *("ProjectionOffsetX", "ProjectionOffsetY"),
)
# Columns are RTK's axes in ours.
_OURS = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def recognises(path: Path) -> bool:
    """Whether it is a geometry of RTK's or a folder with one."""
    return bool(_texts(path))


def read(path: Path, stated: Mapping[str, Any]) -> Acquisition:
    """See `tomo_polysplat.load_scan`; `stated` has its ``scanner``."""
    text = the_one(_texts(path), "one geometry in the folder", "name it")
    folder, known = text.parent, require_known(stated, "scanner")
    frames, origin, spacing, said = _pictures(folder, known)
    known.pop("pixel", None)
    table = _table(text)
    if len(table["GantryAngle"]) != frames.shape[0]:
        got = f"{len(table['GantryAngle'])} views for {frames.shape[0]} pictures"
        raise fail("path", "a view in the geometry for each picture", got, "take the two of one scan")
    told = Acquisition(
        KIND,
        frames,
        geometry_of(table, frames.shape[1:], origin, spacing),
        name=folder.name,
        input="counts" if frames.dtype.kind in "iu" else "attenuation",
        top_first=False,
    ).saying(*said)
    return stated_over(told, known, folder)


def geometry_of(
    table: Mapping[str, np.ndarray],
    size: tuple[int, int],
    origin: tuple[float, float],
    spacing: tuple[float, float],
) -> Geometry:
    """Our geometry of a table of RTK's parameters, (views,) each.

    Parameters
    ----------
    table : mapping
        Angles in degrees, lengths in mm, by the names in RTK's files.
    size : (rows, columns)
    origin, spacing : (x, y)
        Of the pictures, in mm.
    """
    views = len(table["GantryAngle"])
    gantry, out_of_plane, in_plane = (np.deg2rad(table[name]) for name in _ANGLES)
    # From a view's axes to the world: the inverse of the three turns.
    turn = _about(1, gantry) @ _about(0, out_of_plane) @ _about(2, in_plane)
    to_iso, to_detector, source_x, source_y, offset_x, offset_y = (table[name] for name in _LENGTHS)
    source = np.stack([source_x, source_y, to_iso], axis=1)
    corner = np.stack([offset_x + origin[0], offset_y + origin[1], to_iso - to_detector], axis=1)
    steps = [np.tile(spacing[axis] * np.eye(3)[axis], (views, 1)) for axis in (0, 1)]
    world = (np.einsum("vij,vj->vi", _OURS @ turn, vectors) for vectors in (source, corner, *steps))
    origins, corners, u, v = world
    return Geometry("cone", origins, corners, u, v, *size)


def _about(axis: int, angle: np.ndarray) -> np.ndarray:
    """Turns about an axis, counterclockwise seen from its end, (views, 3, 3)."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    turn = np.zeros((len(angle), 3, 3))
    turn[:, axis, axis] = 1.0
    turn[:, first, first] = turn[:, second, second] = np.cos(angle)
    turn[:, second, first], turn[:, first, second] = np.sin(angle), -np.sin(angle)
    return turn


def _texts(path: Path) -> list[Path]:
    files = [path] if path.is_file() else entries_of(path)
    return sorted(
        file for file in files if file.suffix.lower() == ".xml" and file.is_file() and _is_rtk(file)
    )


def _is_rtk(file: Path) -> bool:
    with open(file, "rb") as stream:
        return b"<RTKThreeDCircularGeometry" in stream.read(1024)


def _table(path: Path) -> dict[str, np.ndarray]:
    """Each parameter of each view; what is the same for all may stand once."""
    content = file_content(path, _MOST_BYTES)
    # Entities could grow without end, and RTK writes none.
    if b"<!ENTITY" in content:
        raise fail("path", "a geometry as RTK writes it", f"entities in {path}")
    try:
        root = ElementTree.fromstring(content)
    except ElementTree.ParseError as error:
        raise fail("path", "XML", f"{path} ({error})", "copy or write the file again") from error
    usual = {name: 0.0 for name in (*_ANGLES, *_LENGTHS, "RadiusCylindricalDetector")}
    usual |= _numbers(root, usual)
    if usual["RadiusCylindricalDetector"]:
        raise fail(
            "RadiusCylindricalDetector", "0, a flat detector", f"{usual['RadiusCylindricalDetector']:g}"
        )
    own = [_numbers(view, usual) for view in root.iter("Projection")]
    views = [usual | view for view in own]
    if not views:
        raise fail("path", "views (Projection) in the geometry", f"none in {path}")
    if len(views) > 1 and not any("GantryAngle" in view for view in own):
        got = f"none in {path}, matrices perhaps"
        raise fail("path", "the GantryAngle of each view", got, "write the file with RTK's own writer")
    table = {name: np.array([view[name] for view in views]) for name in (*_ANGLES, *_LENGTHS)}
    if not (table["SourceToDetectorDistance"] > 0).all():
        raise fail(
            "path", "a cone beam", "SourceToDetectorDistance of 0, a parallel one", "use another format"
        )
    return table


def _numbers(element: ElementTree.Element, known: Mapping[str, float]) -> dict[str, float]:
    return {child.tag: require_number(child.tag, child.text) for child in element if child.tag in known}


def _pictures(
    folder: Path, known: dict[str, Any]
) -> tuple[Frames, tuple[float, float], tuple[float, float], list[str]]:
    """Projections with the place of their first pixel, the step from pixel to pixel, and what was guessed."""
    if "projections" in known:
        files = named_files(folder, known["projections"], "projections")
    else:
        files = [file for file in entries_of(folder) if file.suffix.lower() in METAIMAGE_SUFFIXES]
        files = files or [
            f for f in tiffs_in(folder) if not (has_word(f.stem, "flats") or has_word(f.stem, "darks"))
        ]
    if not files or (len(files) > 1 and files[0].suffix.lower() in METAIMAGE_SUFFIXES):
        got = ", ".join(file.name for file in files) or "none"
        raise fail(
            "path", "one .mha file or TIFFs beside the geometry", got, "pass scanner={'projections': ...}"
        )
    if files[0].suffix.lower() in METAIMAGE_SUFFIXES:
        stack = MetaImageFrames(files[0])
        return stack, stack.origin, stack.spacing, []
    frames = TiffFrames(files)
    if "pixel" not in known:
        raise fail(
            "pixel", "the side of a pixel, which TIFFs do not tell", "none", "pass scanner={'pixel': ...}"
        )
    width, height = np.broadcast_to(np.asarray(known["pixel"], float), 2)
    _, rows, columns = frames.shape
    said = ["the pictures are taken to have their middle at 0, before the projection's offsets"]
    return frames, (-(columns - 1) / 2 * width, -(rows - 1) / 2 * height), (width, height), said
