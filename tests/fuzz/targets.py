"""What is fuzzed: each takes hostile input, and either gives something sound or refuses it in words.

Everything else is a finding: another exception, a number that is not finite where it matters, and, watched from
outside by `python -m tests.campaign`, a crash, a hang or a gigabyte.
"""

import math
import shutil
import warnings
from pathlib import Path

import numpy as np
from hostile_checkpoints import checkpoints, resumed
from hostile_files import ARCHIVE, HDF5_RESULTS, HDF5_SCANS, npz_files
from hostile_folders import FILTER_MAPS, SPECTRUM_TABLES, folders, neXus, put
from hostile_stacks import NPZ_STACKS, XRADIA
from hostile_values import ARRAYS, NUMBERS, TEXTS, VALUES, mostly, replaced, replaced_values
from hypothesis import strategies as st

from tomo_polysplat.checks import visible
from tomo_polysplat.cli.options import filter_map_from
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.spectrum_file import read_spectrum_table
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.geometry import from_astra, projections_from_astra
from tomo_polysplat.scan.io import load_scan
from tomo_polysplat.settings import make_settings

REFUSALS = (ValueError, TypeError, OSError, MemoryError)


def refused(action):
    """What an action gives; None when it refuses and says what it expected."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return action()
    except REFUSALS as error:
        assert "expected" in str(error), f"{type(error).__name__} without saying what was expected: {error}"
        assert len(str(error)) < 3000, "a message that nobody reads"
        assert visible(error) == str(error).replace("\n", " "), "control characters in a message"
        return None


def read_scan(content: bytes, folder: Path) -> bool:
    path = folder / "scan"
    path.write_bytes(content)
    return loaded(path)


def loaded(path: Path) -> bool:
    """Whether a file or folder is read as a scan that is sound."""
    scan = refused(lambda: load_scan(path))
    if scan is None:
        return False
    usable = slice(None) if scan.valid is None else scan.valid
    assert np.isfinite(scan.projections[usable]).all()
    assert scan.projections.nbytes < 2**26
    if scan.spectrum is not None:
        assert np.isfinite(scan.spectrum.weights).all()
    refused(lambda: from_astra(scan.proj_geom, scan.vol_geom))
    assert visible(repr(scan)) == repr(scan)
    repr(scan).encode()
    return True


def read_folder(files: dict, folder: Path) -> bool:
    path = folder / "folder"
    shutil.rmtree(path, ignore_errors=True)
    put(files, path)
    return loaded(path)


def read_spectrum(content: bytes, folder: Path) -> bool:
    path = folder / "spectrum.txt"
    path.write_bytes(content)
    made = refused(lambda: Spectrum(*read_spectrum_table(path)))
    assert made is None or (np.isfinite(made.weights).all() and made.effective_energy > 0)
    return made is not None


def read_filter_map(case: tuple, folder: Path) -> bool:
    name, content = case
    path = folder / "filter"
    shutil.rmtree(path, ignore_errors=True)
    put({} if content is None else {name: content}, path)
    found = refused(lambda: filter_map_from(f"Al:{path / name}"))
    assert found is None or (found[1].dtype.kind in "fiu" and found[1].nbytes < 2**26)
    return found is not None


def resume(content: bytes, folder: Path) -> bool:
    path = folder / "fit.npz"
    path.write_bytes(content)
    result = refused(lambda: resumed(path))
    assert result is None or np.isfinite(result.volume).all()
    return result is not None


def read_result(content: bytes, folder: Path) -> bool:
    path = folder / "result"
    path.write_bytes(content)
    result = refused(lambda: Result.load(path))
    if result is None:
        return False
    assert result.volume.shape and repr(result)
    return True


def geometry(case, folder: Path) -> bool:
    proj_geom, vol_geom, projections = case
    if (found := refused(lambda: from_astra(proj_geom, vol_geom))) is None:
        return False
    for name in ("origin", "corner", "u", "v"):
        assert np.isfinite(getattr(found[0], name)).all()
    values = refused(lambda: projections_from_astra(projections, proj_geom))
    assert values is None or values.dtype == np.float32
    return True


def spectrum(arguments, folder: Path) -> bool:
    made = refused(lambda: Spectrum.from_tube(**arguments))
    if made is None:
        return False
    assert np.isfinite(made.weights).all() and made.weights.sum() > 0 and made.effective_energy > 0
    return True


def settings(case, folder: Path) -> bool:
    quality, changes = case
    made = refused(lambda: make_settings(quality, changes))
    if made is None:
        return False
    assert all(math.isfinite(v) for v in made.to_dict().values() if isinstance(v, (int, float)))
    return True


ANGLES = np.linspace(0, 3, 5)
CONE, PLANE = np.tile([9.0, 0, 0, -9, 0, 0, 0, 1, 0, 0, 0, 1], (5, 1)), np.tile([9.0, 0, -9, 0, 0, 1], (5, 1))
FLAT = {"DetectorRowCount": 3, "DetectorColCount": 4}
SPACING = {"DetectorSpacingX": 1.0, "DetectorSpacingY": 1.0}
DISTANCES = {"DistanceOriginSource": 30.0, "DistanceOriginDetector": 10.0}
PROJECTIONS = [
    {"type": "parallel", "DetectorWidth": 1.0, "DetectorCount": 4, "ProjectionAngles": ANGLES},
    {"type": "fanflat", "DetectorWidth": 1.0, "DetectorCount": 4, "ProjectionAngles": ANGLES, **DISTANCES},
    {"type": "parallel_vec", "DetectorCount": 4, "Vectors": PLANE},
    {"type": "fanflat_vec", "DetectorCount": 4, "Vectors": PLANE},
    {"type": "parallel3d", **FLAT, **SPACING, "ProjectionAngles": ANGLES},
    {"type": "cone", **FLAT, **SPACING, **DISTANCES, "ProjectionAngles": ANGLES},
    {"type": "parallel3d_vec", **FLAT, "Vectors": CONE},
    {"type": "cone_vec", **FLAT, "Vectors": CONE},
    {"type": "cyl_cone_vec", **FLAT, "Vectors": np.c_[CONE, np.full(5, 18.0)]},
]
WINDOW = {f"Window{end}{axis}": sign * 2.0 for axis in "XYZ" for end, sign in (("Min", -1), ("Max", 1))}
COUNTS = {"GridRowCount": 4, "GridColCount": 4, "GridSliceCount": 4}
VOLUMES = (
    replaced(COUNTS) | replaced(WINDOW).map(lambda window: COUNTS | {"option": window}) | st.just(COUNTS)
)
TUBE = {"kvp": 90.0, "anode": "W", "filters": {"Al": 0.1}}
FILTERS = TEXTS | st.sampled_from(["Al", "Cu", "iron"])
NAMES = st.sampled_from(list(make_settings().to_dict()))

# What is in files, and what is in arguments.
FILES = {
    "npz scans": (read_scan, npz_files(ARCHIVE)),
    "Data Exchange": (read_scan, HDF5_SCANS),
    "NXtomo": (read_scan, neXus("nxtomo")),
    "CIL NeXus": (read_scan, neXus("cil")),
    "TIFF folders": (read_folder, folders("tiffs")),
    "scan.toml": (read_folder, folders("tiffs", ("scan.toml", "angles.txt"))),
    "SkyScan": (read_folder, folders("skyscan")),
    "Nikon": (read_folder, folders("nikon")),
    "EDF": (read_folder, folders("edf")),
    "ESRF": (read_folder, folders("esrf")),
    ".npy": (read_folder, folders("npy")),
    "RTK and MetaImage": (read_folder, folders("rtk")),
    "Zeiss .txrm and .xrm": (read_folder, XRADIA),
    ".npz stacks": (read_folder, NPZ_STACKS),
    "spectrum tables": (read_spectrum, SPECTRUM_TABLES),
    "filter maps": (read_filter_map, FILTER_MAPS),
    "results": (read_result, HDF5_RESULTS),
    "checkpoints": (resume, checkpoints()),
}
ARGUMENTS = {
    "geometries": (
        geometry,
        st.tuples(
            mostly(st.sampled_from(PROJECTIONS).flatmap(replaced)),
            mostly(VOLUMES | replaced({"GridRowCount": 4, "GridColCount": 4})),
            ARRAYS | st.just(np.ones((3, 5, 4))) | VALUES,
        ),
    ),
    "spectra": (
        spectrum,
        replaced_values(TUBE, VALUES | st.dictionaries(FILTERS, NUMBERS, max_size=2)),
    ),
    "settings": (
        settings,
        st.tuples(
            mostly(st.sampled_from(["fast", "balanced", "best"])),
            mostly(st.dictionaries(NAMES, NUMBERS | VALUES, max_size=2)),
        ),
    ),
}
TARGETS = FILES | ARGUMENTS
