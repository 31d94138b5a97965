"""CIL's NeXus: orders of axes, panels that begin elsewhere, packed numbers, an axis that is tilted."""

import h5py
import numpy as np
import pytest
from folders import marked, require_the_same_volume

import tomo_polysplat as tps
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.simulate.folders.scene import SETTINGS
from tomo_polysplat.simulate.folders.write import write_folder

DATA = "entry1/tomo_entry/data/data"


@pytest.fixture
def path(tmp_path):
    write_folder("cil", tmp_path / "sample", marked())
    return tmp_path / "sample" / "marker.nxs"


def test_the_axes_in_another_order_packed_and_seen_from_behind(path):
    with h5py.File(path, "r+") as file:
        about, values = dict(file[DATA].attrs), file[DATA][()]
        del file[DATA]
        # From 16 bits: (stored - offset) / scale.
        file[DATA] = np.rint(values[::-1, :, ::-1].transpose(1, 0, 2) * 20000.0 + 1000.0).astype(np.uint16)
        about |= {"dim0": "angle", "dim1": "vertical", "panel_origin": "bottom-right"}
        for name, value in (about | {"scale": 20000.0, "offset": 1000.0}).items():
            file[DATA].attrs[name] = value
    scan = tps.load_scan(path)
    require_the_same_volume(scan, marked())
    assert any("no unit of length" in guess for guess in scan.notes["scanner"]["guessed"])
    part = tps.load_scan(path, views=(1, 9, 2), rows=(4, 20), columns=(3, 33))
    np.testing.assert_array_equal(part.projections, scan.projections[4:20, 1:9:2, 37 - 33 : 37 - 3])


def test_a_frame_that_is_turned_as_a_whole_is_the_same_scanner(path):
    """Where points on the axis fall does not depend on the frame in which everything is told."""
    before = from_astra(*astra_of(path))[0]
    angle = 0.3
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    with h5py.File(path, "r+") as file:
        for name in ("source/position", "detector/position", "detector/direction_x", "detector/direction_y"):
            turned(file, name, turn)
        turned(file, "rotation_axis/position", turn)
        turned(file, "rotation_axis/direction", turn)
    after = from_astra(*astra_of(path))[0]
    on_axis = np.array([[0.0, 0.0, -4.0], [0.0, 0.0, 0.0], [0.0, 0.0, 6.0]])
    np.testing.assert_allclose(after.project_points(on_axis), before.project_points(on_axis), atol=1e-4)


def astra_of(path):
    scan = tps.load_scan(path)
    return scan.proj_geom, scan.vol_geom


def turned(file, name, turn):
    vector = file[f"entry1/tomo_entry/config/{name}"]
    vector[...] = turn @ vector[()]


def test_what_it_cannot_mean_is_refused(path):
    with h5py.File(path, "r+") as file:
        file[DATA].attrs["dim1"] = "channel"
    with pytest.raises(ValueError, match="the axes angle, vertical, horizontal, got vertical, channel"):
        tps.load_scan(path)


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_a_file_of_before_version_20_11(tmp_path, beam):
    """Distances, pixel and angles alone; nothing tells that those are radians but that they make one turn."""
    own = marked(beam)
    rows, views, columns = own.projections.shape
    at = SETTINGS
    about = {
        "data_type": "AcquisitionData",
        "geom_type": beam,
        "dim0": "vertical",
        "dim1": "angle",
        "dim2": "horizontal",
    }
    pixel = at.pixel if beam == "cone" else at.pixel * at.source_object / at.source_detector
    about |= {"pixel_size_h": pixel, "pixel_size_v": pixel}
    if beam == "cone":
        about |= {
            "dist_source_center": at.source_object,
            "dist_center_detector": at.source_detector - at.source_object,
        }
    with h5py.File(tmp_path / "old.nxs", "w") as file:
        file[DATA] = own.projections
        for name, value in about.items():
            file[DATA].attrs[name] = value
        degrees = np.arange(views) * (360.0 / views)
        file["entry1/tomo_entry/data/rotation_angle"] = np.deg2rad(degrees).astype(np.float32)
    stated = {"offset": (at.columns_off * pixel, 0.0), "unit": "mm", "input": "attenuation"}
    scan = tps.load_scan(tmp_path / "old.nxs", scanner=stated)
    require_the_same_volume(scan, own)
    assert any("taken for radians" in guess for guess in scan.notes["scanner"]["guessed"])
    with h5py.File(tmp_path / "old.nxs", "r+") as file:
        file["entry1/tomo_entry/data/rotation_angle"][...] = degrees
    other = tps.load_scan(tmp_path / "old.nxs", scanner=stated)
    np.testing.assert_allclose(other.proj_geom["Vectors"], scan.proj_geom["Vectors"], atol=1e-4)
    with h5py.File(tmp_path / "old.nxs", "r+") as file:
        file[DATA].attrs["geom_type"] = "cone"
        file[DATA].attrs.pop("dist_source_center", None)
    with pytest.raises(ValueError, match="dist_source_center and dist_center_detector"):
        tps.load_scan(tmp_path / "old.nxs")
