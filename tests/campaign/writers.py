"""Everything that writes a file or a folder, each able to write an old state and a new one."""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from unittest import mock

import numpy as np

import tomo_polysplat as tps
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.geometry import VolumeGrid

__all__ = ["Writer", "content", "writers"]

SHAPE = (24, 40, 41)
# OME-XML wants a number of its own for each file.
_LOT = re.compile(rb"urn:uuid:[0-9a-f-]{36}")
ENDINGS = ("h5", "npy", "tif", "ome.tif", "stack/", "mha", "nrrd", "nii", "nii.gz", "vti")


@dataclass(frozen=True)
class Writer:
    """Something that writes `name` in a folder.

    Attributes
    ----------
    name : str
    write : function of a path and of 0 or 1
        Writes the one or the other state over what is there.
    """

    name: str
    write: Callable[[Path, int], object]

    @property
    def file(self) -> str:
        return "out." + self.name.split()[-1].strip("/")


def content(path: Path) -> object:
    """All that is in a file or a folder but what is drawn by lot; None where there is none."""
    if path.is_dir():
        files = sorted(inner for inner in path.rglob("*") if inner.is_file())
        return {str(inner.relative_to(path)): inner.read_bytes() for inner in files}
    return _LOT.sub(b"", path.read_bytes()) if path.exists() else None


@cache
def result(state: int) -> Result:
    """Of other numbers, and of other size."""
    shape = (SHAPE[0] + 3 * state, *SHAPE[1:])
    basis = np.random.default_rng(state).random((1, *shape)).astype(np.float32)
    history = [{"seconds": float(k), "iteration": k, "loss": 1.0, "held_out": None} for k in range(50)]
    return Result(basis, VolumeGrid(shape, np.zeros(3), np.ones(3)), "cm", 50.0, history=history)


@cache
def scan(state: int) -> tps.Scan:
    return tps.simulate_scan("pins", size=12, views=20 + state, seed=state)


def _saved(ending: str) -> Writer:
    def write(path: Path, state: int) -> None:
        result(state).save(f"{path}/" if ending.endswith("/") else path, overwrite=True)

    return Writer(f"result {ending}", write)


def _zarr() -> Writer:
    """Of blocks so small that there are many."""

    def write(path: Path, state: int) -> None:
        with mock.patch("tomo_polysplat.result.ome_zarr._BLOCK", 16):
            result(state).save(path, overwrite=True)

    return Writer("result ome.zarr", write)


def _dicom() -> Writer:
    """With identifiers that are counted, which are else drawn by lot."""

    def write(path: Path, state: int) -> None:
        count = itertools.count(10**37 * (1 + state))
        with mock.patch("pydicom.uid.generate_uid", lambda prefix: f"2.25.{next(count)}"):
            result(state).save(path, overwrite=True)

    return Writer("result dicom", write)


def _imported(place: Path) -> Writer:
    """The command, of a folder of TIFFs."""
    from tomo_polysplat.cli import main
    from tomo_polysplat.simulate.folders.scene import marked_scan
    from tomo_polysplat.simulate.folders.write import write_folder

    folders = [place / f"tiffs{state}" for state in (0, 1)]
    for state, folder in enumerate(folders):
        write_folder("tiffs", folder, marked_scan(6, 20, 20 + state))

    def write(path: Path, state: int) -> None:
        with (
            open(os.devnull, "w") as nowhere,
            contextlib.redirect_stdout(nowhere),
            contextlib.redirect_stderr(nowhere),
        ):
            status = main(["import", str(folders[state]), "-o", str(path), "--overwrite"])
        if status:
            raise OSError(f"import ended with status {status}")

    return Writer("import h5", write)


def writers(place: Path, names: list[str] | None = None) -> list[Writer]:
    """All of them, or those that are named; what they need is made in the folder."""
    from tomo_polysplat.result.files import write_json

    some = [*(_saved(ending) for ending in ENDINGS), _zarr(), _dicom()]
    for ending in ("npz", "h5"):
        some.append(
            Writer(f"scan {ending}", lambda path, state: tps.save_scan(scan(state), path, overwrite=True))
        )
    some.append(Writer("report html", lambda path, state: result(state).report(path, overwrite=True)))
    some.append(
        Writer("numbers json", lambda path, state: write_json(path, {"n": [state] * 200_000}, overwrite=True))
    )
    if names is None or "import h5" in names:
        some.append(_imported(place))
    return [one for one in some if names is None or one.name in names]


def remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    elif path.exists():
        path.unlink()
