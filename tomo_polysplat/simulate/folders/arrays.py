"""Plain folders of arrays: NumPy's .npy and .npz files, and the ESRF's EDF pictures, beside a small TOML file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tomo_polysplat.simulate.folders.scene import SETTINGS, Pictures
from tomo_polysplat.simulate.folders.tiffs import write_distances

__all__ = ["edf_bytes", "write_edf", "write_esrf", "write_npy", "write_npz"]

_EDF_TYPES = {"u2": "UnsignedShort", "f4": "FloatValue", "i4": "SignedInteger"}
_EDF_BLOCK = 512


def write_npy(folder: Path, pictures: Pictures) -> None:
    """Fill an empty folder with three stacks."""
    for name in ("projections", "flats", "darks"):
        np.save(folder / f"{name}.npy", getattr(pictures, name))
    write_distances(folder)


def write_npz(folder: Path, pictures: Pictures) -> None:
    """Fill an empty folder with one archive."""
    stacks = {name: getattr(pictures, name) for name in ("projections", "flats", "darks", "degrees")}
    np.savez_compressed(folder / "marker.npz", **stacks)
    write_distances(folder)


def write_edf(folder: Path, pictures: Pictures) -> None:
    """Fill an empty folder: a picture a file, and all flats in one."""
    for index, picture in enumerate(pictures.projections):
        (folder / f"marker{index:04d}.edf").write_bytes(edf_bytes(picture))
    (folder / "flat.edf").write_bytes(b"".join(edf_bytes(flat) for flat in pictures.flats))
    (folder / "dark.edf").write_bytes(edf_bytes(pictures.darks[0]))
    write_distances(folder)


def write_esrf(folder: Path, pictures: Pictures) -> None:
    """Fill an empty folder as the ESRF's beamlines did: the .info text, references, and pictures of the way back."""
    views, rows, columns = pictures.projections.shape
    for index, picture in enumerate([*pictures.projections, *pictures.projections[::-24]]):
        (folder / f"marker{index:04d}.edf").write_bytes(edf_bytes(picture))
    for index in (0, views):
        flat = np.median(pictures.flats, axis=0).astype(np.float32)
        (folder / f"refHST{index:04d}.edf").write_bytes(edf_bytes(flat))
        (folder / f"ref0000_{index:04d}.edf").write_bytes(edf_bytes(pictures.flats[0]))
    (folder / "dark.edf").write_bytes(edf_bytes(pictures.darks.mean(axis=0).astype(np.float32)))
    pixel = 1000 * SETTINGS.pixel * SETTINGS.source_object / SETTINGS.source_detector
    (folder / "marker.info").write_text(
        f"Energy=                 60.0\nDistance=               100\nPrefix=                 marker\n"
        f"ScanRange=              360\nTOMO_N=                 {views}\nREF_ON=                 {views}\n"
        f"REF_N=                  1\nDARK_N=                 1\nDim_1=                  {columns}\n"
        f"Dim_2=                  {rows}\nCount_time=             0.1\nPixelSize=              {pixel:g}\n",
        encoding="ascii",
    )


def edf_bytes(picture: np.ndarray, **others: object) -> bytes:
    """One picture (rows, columns) as EDF: a header that fills whole blocks, and the numbers."""
    rows, columns = picture.shape
    about: dict[str, object] = {
        "HeaderID": "EH:000001:000000:000000",
        "ByteOrder": "HighByteFirst" if picture.dtype.byteorder == ">" else "LowByteFirst",
        "DataType": _EDF_TYPES[picture.dtype.str[1:]],
        "Dim_1": columns,
        "Dim_2": rows,
        "Size": picture.nbytes,
        **others,
    }
    text = "{\n" + "".join(f"{key} = {value} ;\n" for key, value in about.items())
    blank = -(len(text) + 2) % _EDF_BLOCK
    return (text + " " * blank + "}\n").encode("ascii") + picture.tobytes()
