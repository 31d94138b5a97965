"""NXtomo files: keys, units, and beams that are as good as parallel."""

import h5py
import numpy as np
import pytest
from folders import marked, require_the_same_volume

import tomo_polysplat as tps
from tomo_polysplat.simulate.folders.write import write_folder


@pytest.fixture
def path(tmp_path):
    write_folder("nxtomo", tmp_path / "sample", marked())
    return tmp_path / "sample" / "marker.nx"


def test_the_file_alone_and_what_it_tells(path):
    scan = tps.load_scan(path)
    require_the_same_volume(scan, marked())
    told = scan.notes["scanner"]
    assert told["exposure_s"] == "0.1" and told["keys"] == {"title": "a marker"} and scan.name == "marker"
    assert scan.views == 48 and scan.spectrum is None
    (guess,) = told["guessed"]
    assert "the voltage of the tube is not known" in guess and "give kvp=" in guess
    part = tps.load_scan(path, views=(1, 9, 2), rows=(4, 20), columns=(3, 33))
    np.testing.assert_array_equal(part.projections, scan.projections[33 - 20 : 33 - 4, 1:9:2, 3:33])


def test_a_source_far_away_sends_a_parallel_beam(path):
    own = marked("parallel")
    path.unlink()
    write_folder("nxtomo", path.parent, own)
    with h5py.File(path, "a") as file:
        entry = file["entry0000"]
        entry["instrument/source/distance"][()] = 145.0
        for axis in "xy":
            entry[f"instrument/detector/{axis}_pixel_size"][()] = 640.0
            entry[f"instrument/detector/{axis}_pixel_size"].attrs["units"] = "um"
        entry["sample/rotation_angle"][()] = np.deg2rad(entry["sample/rotation_angle"][()])
        entry["sample/rotation_angle"].attrs["units"] = "rad"
    scan = tps.load_scan(path)
    require_the_same_volume(scan, own)
    assert any("parallel" in guess for guess in scan.notes["scanner"]["guessed"])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("image_key", np.ones(55, int), "pictures of image_key 0"),
        ("image_key", np.zeros(3, int), r"shape \(55,\)"),
        ("data", np.zeros((55, 4)), "pictures in instrument/detector/data"),
    ],
)
def test_files_that_cannot_be_meant(path, name, value, message):
    with h5py.File(path, "a") as file:
        del file[f"entry0000/instrument/detector/{name}"]
        file[f"entry0000/instrument/detector/{name}"] = value
    with pytest.raises(ValueError, match=message):
        tps.load_scan(path)


def test_an_unknown_unit_is_refused(path):
    with h5py.File(path, "a") as file:
        file["entry0000/instrument/detector/distance"].attrs["units"] = "furlong"
    with pytest.raises(
        ValueError, match="units of instrument/detector/distance: expected one of m, .*furlong"
    ):
        tps.load_scan(path)


def test_an_entry_within_an_entry(path):
    """As a beamline of Diamond's writes it: entry1/tomo_entry."""
    exact = tps.load_scan(path)
    with h5py.File(path, "a") as file:
        file.move("entry0000", "later")
        file.create_group("entry1/before_scan")
        file.move("later", "entry1/tomo_entry")
    np.testing.assert_array_equal(tps.load_scan(path).projections, exact.projections)


def flipped(path, axes):
    """The stored pictures exchanged along these axes of (pictures, rows, columns)."""
    with h5py.File(path, "a") as file:
        data = file["entry0000/instrument/detector/data"]
        data[...] = np.flip(data[()], axes)


def turn(path, name, axis, degrees=180, kind="rotation"):
    with h5py.File(path, "a") as file:
        dataset = file.require_group("entry0000/instrument/detector/transformations").create_dataset(
            name, data=degrees
        )
        dataset.attrs["transformation_type"], dataset.attrs["vector"] = kind, axis


@pytest.mark.parametrize(
    ("axes", "turns"),
    [
        # The ESRF's axes: x along the beam, z up. Left and right, top and bottom, both, and a turn by nothing.
        ((2,), {"rz": (0, 0, 1)}),
        ((1,), {"ry": (0, 1, 0)}),
        ((1, 2), {"rz": (0, 0, 1), "ry": (0, 1, 0), "gravity": (0, 0, -1)}),
        # McStas': z along the beam, y up, which gravity tells.
        ((2,), {"ry": (0, 1, 0), "gravity": (0, -1, 0)}),
        ((1,), {"rx": (1, 0, 0), "gravity": (0, -1, 0)}),
    ],
)
def test_flips_that_the_file_tells_of_are_undone(path, axes, turns):
    flipped(path, axes)
    for name, axis in turns.items():
        gravity = name == "gravity"
        turn(path, name, axis, *((9.8, "gravity") if gravity else ()))
    turn(path, "none", (0, 1, 0), 0)
    turn(path, "shift", (0, 0, 1), 180, "translation")
    if 2 in axes:
        with h5py.File(path, "a") as file:
            position = file["entry0000/instrument/detector/x_rotation_axis_pixel_position"]
            position[()] = -position[()]
    scan = tps.load_scan(path)
    assert "exchanged, which is undone" in " | ".join(scan.notes["scanner"]["guessed"])
    require_the_same_volume(scan, marked())


def test_flips_as_older_files_tell_them(path):
    flipped(path, (1,))
    with h5py.File(path, "a") as file:
        file["entry0000/instrument/detector/y_flipped"] = True
        file["entry0000/instrument/detector/x_flipped"] = False
    require_the_same_volume(tps.load_scan(path), marked())


def test_an_axis_counted_from_the_first_column(path):
    """Some beamlines write the column itself; with half a field of view the axis may be far from the middle."""
    exact = tps.load_scan(path)
    with h5py.File(path, "a") as file:
        position = file["entry0000/instrument/detector/x_rotation_axis_pixel_position"]
        position[()] += (37 - 1) / 2
    scan = tps.load_scan(path)
    assert "counted from the first" in " | ".join(scan.notes["scanner"]["guessed"])
    np.testing.assert_allclose(scan.proj_geom["Vectors"], exact.proj_geom["Vectors"], atol=1e-9)
    with h5py.File(path, "a") as file:
        file["entry0000/instrument/detector/field_of_view"] = "Half"
    scan = tps.load_scan(path)
    assert "counted from the first" not in " | ".join(scan.notes["scanner"]["guessed"])


DATA = "entry0000/instrument/detector/data"


def taken_out(path, into):
    """The pictures in three other files, and what they are."""
    into.mkdir(exist_ok=True)
    with h5py.File(path, "a") as file:
        data = file[DATA][()]
        del file[DATA]
    parts = np.array_split(np.arange(len(data)), 3)
    for number, part in enumerate(parts):
        with h5py.File(into / f"raw_{number}.h5", "w") as file:
            file["entry/data"] = data[part]
    return data, parts


def put_together(path, name, data, parts):
    layout = h5py.VirtualLayout(data.shape, data.dtype)
    for number, part in enumerate(parts):
        shape = (len(part), *data.shape[1:])
        layout[part[0] : part[-1] + 1] = h5py.VirtualSource(name.format(number), "entry/data", shape=shape)
    with h5py.File(path, "a") as file:
        file.create_virtual_dataset(DATA, layout)


def test_pictures_behind_a_link_to_another_file(path):
    expected = tps.load_scan(path).projections
    with h5py.File(path, "a") as file, h5py.File(path.parent / "raw.h5", "w") as other:
        other["entry/data"] = file[DATA][()]
        del file[DATA]
        file[DATA] = h5py.ExternalLink("raw.h5", "entry/data")
    np.testing.assert_array_equal(tps.load_scan(path).projections, expected)


# The second as a beamline writes it, from which somebody has copied all files into one folder.
@pytest.mark.parametrize("name", ["scan1/raw_{}.h5", "/data/visitor/RAW_DATA/raw_{}.h5"])
def test_pictures_of_several_files(path, name):
    expected = tps.load_scan(path).projections
    into = path.parent / "scan1" if name.startswith("scan1") else path.parent
    put_together(path, name, *taken_out(path, into))
    np.testing.assert_array_equal(tps.load_scan(path).projections, expected)


def test_pictures_of_files_that_are_not_there(path):
    """HDF5 itself would give zeros for them, or look elsewhere."""
    put_together(path, "../other/raw_{}.h5", *taken_out(path, path.parent.parent / "other"))
    with pytest.raises(
        ValueError, match=r"a link to \.\./other/raw_..h5, which is not there.*put raw_..h5"
    ) as told:
        tps.load_scan(path)
    for file in (path.parent.parent / "other").iterdir():
        file.rename(path.parent / file.name)  # what the message says
    assert str(path.parent) in str(told.value) and tps.load_scan(path).views == 48
    (path.parent / "raw_1.h5").unlink()
    with pytest.raises(ValueError, match="raw_1.h5, which is not there"):
        tps.load_scan(path)


def as_diamond_writes(path):
    """The same scan with a detector of another name, and angles beside its pictures, in other files below."""
    below = path.parent / "raw"
    below.mkdir()
    with h5py.File(path, "r") as file:
        detector = file["entry0000/instrument/detector"]
        keys, pictures = detector["image_key"][()], detector["data"][()]
        degrees = file["entry0000/sample/rotation_angle"][()]
    for name, inside, values in (("camera", "detector/detector", pictures), ("panda", "theta", degrees)):
        with h5py.File(below / f"{name}.h5", "w") as file:
            file[f"entry/{inside}"] = values
    path.unlink()
    links = {
        # Of another detector only the keys are there.
        "instrument/EtherCAT/data": h5py.ExternalLink("raw/gone.h5", "/entry/detector/detector"),
        "instrument/imaging/data": h5py.ExternalLink("raw/camera.h5", "/entry/detector/detector"),
        "imaging/data": h5py.ExternalLink("raw/camera.h5", "/entry/detector/detector"),
        "imaging/gts_theta_value": h5py.ExternalLink("raw/panda.h5", "/entry/theta"),
        "imaging/gts_theta_value_set": h5py.ExternalLink("raw/gone.h5", "/entry/theta"),
    }
    with h5py.File(path.with_suffix(".nxs"), "w") as file:
        entry = file.create_group("entry")
        for name, link in links.items():
            entry.require_group(name.rpartition("/")[0])
            entry[name] = link
        for name in ("EtherCAT", "imaging"):
            entry[f"instrument/{name}/image_key"] = keys
    return path.with_suffix(".nxs")


def test_a_detector_and_angles_of_other_names(path):
    """As Diamond's program for data acquisition writes them: lengths and the axis are told by the user."""
    expected = tps.load_scan(path)
    scan = tps.load_scan(
        as_diamond_writes(path),
        scanner={"source_object": 100, "source_detector": 250, "pixel": 1.6, "offset": (2.4, 0)},
    )
    np.testing.assert_array_equal(scan.projections, expected.projections)
    np.testing.assert_allclose(scan.proj_geom["Vectors"], expected.proj_geom["Vectors"], atol=1e-9)


def test_pictures_that_are_in_a_file_that_is_not_there(path):
    moved = as_diamond_writes(path)
    (path.parent / "raw" / "camera.h5").unlink()
    with pytest.raises(ValueError, match="put gone.h5|put camera.h5"):
        tps.load_scan(moved)


def test_angles_beside_the_data_of_a_usual_file(path):
    expected = tps.load_scan(path)
    with h5py.File(path, "a") as file:
        file["entry0000"].move("sample/rotation_angle", "data/rotation_angle")
    scan = tps.load_scan(path)
    np.testing.assert_array_equal(scan.proj_geom["Vectors"], expected.proj_geom["Vectors"])
    with h5py.File(path, "a") as file:
        del file["entry0000/data/rotation_angle"]
    with pytest.raises(ValueError, match="sample/rotation_angle"):
        tps.load_scan(path)


def test_a_voltage_without_the_size_of_a_pixel_is_said_to_be_of_no_use(path):
    with h5py.File(path, "a") as file:
        for axis in "xy":
            del file[f"entry0000/instrument/detector/{axis}_pixel_size"]
    scan = tps.load_scan(path, scanner={"kvp": 90, "filter": "Al 1mm"})
    assert scan.unit == "pixel" and scan.spectrum is None
    assert any(
        "a spectrum cannot be used; give pixel=" in guess for guess in scan.notes["scanner"]["guessed"]
    )


def test_lengths_that_are_texts_are_not_known(path):
    """Diamond's older files link what nobody measured to the name of the scan."""
    expected = tps.load_scan(path)
    with h5py.File(path, "a") as file:
        entry = file["entry0000"]
        entry["scan_identifier"] = np.array([b"b2017b74"])
        for name in ("x_pixel_size", "y_pixel_size", "distance"):
            del entry[f"instrument/detector/{name}"]
            entry[f"instrument/detector/{name}"] = h5py.SoftLink("/entry0000/scan_identifier")
    scan = tps.load_scan(path)
    assert scan.unit == "pixel" and scan.proj_geom["type"] == "parallel3d_vec"
    np.testing.assert_array_equal(scan.projections, expected.projections)


def test_an_nxtomo_in_an_entry_comes_before_the_entry_s_own_detectors(path):
    """As in files that Diamond's program made for tomography: both have keys, one has the angles of each picture."""
    expected = tps.load_scan(path)
    with h5py.File(path, "a") as file:
        file.create_group("entry1")
        file.move("entry0000", "entry1/tomo_entry")
        other = file.create_group("entry1/instrument/camera")
        other["data"], other["image_key"] = np.ones((5, 3, 3)), np.zeros(5, int)
    scan = tps.load_scan(path)
    np.testing.assert_array_equal(scan.projections, expected.projections)


def test_pictures_of_the_way_back_are_no_views(path):
    expected = tps.load_scan(path)
    with h5py.File(path, "a") as file:
        detector = file["entry0000/instrument/detector"]
        keys = detector["image_key"][()]
        control = keys.copy()
        control[np.flatnonzero(keys == 0)[-3:]] = -1
        detector["image_key_control"] = control
    scan = tps.load_scan(path)
    np.testing.assert_array_equal(scan.projections, expected.projections[:, :-3])
    assert any("3 pictures of the way back" in guess for guess in scan.notes["scanner"]["guessed"])


def test_a_monitor_makes_up_for_a_beam_that_falls(path):
    expected = tps.load_scan(path)
    with h5py.File(path, "a") as file:
        entry = file["entry0000"]
        data, keys = entry["instrument/detector/data"], entry["instrument/detector/image_key"][()]
        beam = np.where(keys == 0, np.linspace(1.0, 0.85, len(keys)), 1.0)
        dark = data[()][keys == 2].mean(axis=0)
        dimmed = dark + (data[()] - dark) * beam[:, None, None]
        data[()] = np.where((keys == 0)[:, None, None], np.round(dimmed), data[()])
        entry["control/data"] = 190.0 * beam
    scan = tps.load_scan(path)
    np.testing.assert_allclose(scan.projections, expected.projections, atol=3e-3)
    assert any("control/data" in guess for guess in scan.notes["scanner"]["guessed"])
    part = tps.load_scan(path, views=(1, 40, 3))
    np.testing.assert_array_equal(part.projections, scan.projections[:, 1:40:3])
    with h5py.File(path, "a") as file:
        file["entry0000/control/data"][3] = 0.0
    dim = tps.load_scan(path).projections
    assert (dim - expected.projections)[:, -1].mean() > 0.1, "a monitor that failed tells nothing"


def test_other_entries_are_said(path):
    with h5py.File(path, "a") as file:
        file.copy("entry0000", "entry0001")
    said = " | ".join(tps.load_scan(path).notes["scanner"]["guessed"])
    assert "the entry entry0000 is read; others of the file (entry0001)" in said
