"""Folders as an Xradia of Zeiss' writes them: pictures that drift, and one of the open beam; in one file or many."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tomo_polysplat.scan.readers.xradia_series import PER_PICTURE
from tomo_polysplat.simulate.folders.compound_file import compound_file
from tomo_polysplat.simulate.folders.scene import SETTINGS, Pictures

__all__ = ["single_views", "streams_of", "write", "write_single_views"]

_UNSIGNED_SHORT, _FLOAT = 5, 10
_ONE = np.array(1, "<i4").tobytes()
# Columns and rows by which every third picture is displaced.
_MOVED = (2, -1)


def write(folder: Path, pictures: Pictures) -> None:
    """Fill an empty folder; the first row is the lowest, and dark counts are taken out already."""
    (folder / "marker.txrm").write_bytes(compound_file(streams_of(pictures)))


def write_single_views(folder: Path, pictures: Pictures) -> None:
    """Fill an empty folder with one .xrm file a view, and one of the open beam."""
    for name, streams in single_views(pictures).items():
        (folder / name).write_bytes(compound_file(streams))


def single_views(pictures: Pictures) -> dict[str, dict[str, bytes]]:
    """What each of such files says, by its name."""
    whole, files = streams_of(pictures), {}
    shared = {name: content for name, content in whole.items() if not name.startswith(("ImageData", "Ref"))}
    shared |= {f"ImageInfo/{name}": _ONE for name in ("NoOfImages", "ImagesTaken")}
    for k in range(len(pictures.degrees)):
        own = {name: whole[name][4 * k : 4 * k + 4] for name in PER_PICTURE}
        picture = {"ImageData1/Image1": whole[f"ImageData{k // 100 + 1}/Image{k + 1}"]}
        files[f"marker_{k + 1:04d}.xrm"] = shared | own | picture
    open_beam = {"ImageData1/Image1": whole["ReferenceData/Image"]}
    open_beam |= {"ImageInfo/DataType": whole["ReferenceData/DataType"]}
    files["marker_ref.xrm"] = files["marker_0001.xrm"] | open_beam
    return files


def _displaced(pictures: np.ndarray) -> np.ndarray:
    """What a detector sees that stands `_MOVED` further: what comes in at an edge is as the edge was."""
    _, rows, columns = pictures.shape
    row = np.clip(np.arange(rows) + _MOVED[1], 0, rows - 1)
    column = np.clip(np.arange(columns) + _MOVED[0], 0, columns - 1)
    return pictures[:, row[:, None], column]


def streams_of(pictures: Pictures) -> dict[str, bytes]:
    """What such a file says, by the names of its streams."""
    at, (views, rows, columns) = SETTINGS, pictures.projections.shape
    flat = (pictures.flats.mean(axis=0) - pictures.darks[0])[::-1]
    passed = (pictures.projections - pictures.darks[0].astype(np.float64))[:, ::-1] / flat
    moved = np.arange(views) % 3 == 1
    passed[moved] = _displaced(passed[moved])
    counts = np.maximum(np.rint(passed * flat), 0).astype("<u2")
    whole = {"ImageWidth": columns, "ImageHeight": rows, "NoOfImages": views, "ImagesTaken": views}
    whole |= {"DataType": _UNSIGNED_SHORT, "XrayGeometry": 1, "CameraBinning": 1}
    streams = {f"ImageInfo/{name}": np.array(value, "<i4").tobytes() for name, value in whole.items()}
    near, behind = at.source_object, at.source_detector - at.source_object
    real = {
        "ImageInfo/PixelSize": 1e3 * at.pixel * near / at.source_detector,
        "ImageInfo/Voltage": at.kvp,
        "ImageInfo/Angles": -pictures.degrees,
        "ImageInfo/StoRADistance": np.full(views, -near),
        "ImageInfo/DtoRADistance": np.full(views, behind),
        "ImageInfo/ExpTimes": np.full(views, 0.5),
        "ReferenceData/ExpTime": 0.5,
        "Alignment/X-Shifts": moved * _MOVED[0],
        "Alignment/Y-Shifts": moved * _MOVED[1],
        "ReconSettings/CenterShift": at.columns_off,
        "ReferenceData/Image": flat,
    }
    streams |= {name: np.asarray(value, "<f4").tobytes() for name, value in real.items()}
    streams["ReferenceData/DataType"] = np.array(_FLOAT, "<i4").tobytes()
    streams["AcquisitionSettings/SourceFilterName"] = f"Al {at.filter_mm}mm".encode().ljust(260, b"\0")
    for k, picture in enumerate(counts):
        streams[f"ImageData{k // 100 + 1}/Image{k + 1}"] = picture.tobytes()
    return streams
