"""A SkyScan's folder: what its log says, what it leaves open, and what it cannot mean."""

import numpy as np
import pytest
import tifffile
from folders import marked, require_the_same_volume

import tomo_polysplat as tps
from tomo_polysplat.physics.filter_text import filters_of
from tomo_polysplat.simulate.folders.scene import marked_scan, pictures_of
from tomo_polysplat.simulate.folders.skyscan import log_text
from tomo_polysplat.simulate.folders.tiffs import write_pictures
from tomo_polysplat.simulate.folders.write import write_folder


@pytest.fixture
def folder(tmp_path):
    write_folder("skyscan", tmp_path / "sample", marked())
    return tmp_path / "sample"


def change(folder, *pairs):
    log = folder / "marker_.log"
    text = log.read_text()
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    log.write_text(text)


def guesses(scan):
    return " | ".join(scan.notes["scanner"]["guessed"])


def test_the_log_is_kept_and_nothing_but_the_detector_is_guessed(folder):
    scan = tps.load_scan(folder)
    told = scan.notes["scanner"]
    assert (told["kind"], told["tube_kv"], told["filter"]) == ("Bruker SkyScan (.log)", "90.0", "1 mm Al")
    assert told["exposure_s"] == "0.057" and scan.name == "marker" and len(told["guessed"]) == 1
    assert told["keys"]["System/Scanner"] == "SkyScan1275" and "Acquisition/Exposure (ms)" not in told["keys"]
    # Air is brighter than the open beam in half of the pixels, and never saturated.
    assert scan.valid is None and (scan.projections < 0).mean() > 0.2


def test_raw_pictures_with_flats_and_darks_that_turn_the_other_way(tmp_path):
    pictures = pictures_of(marked())
    for prefix, frames in (
        ("marker_", pictures.projections),
        ("flat", pictures.flats),
        ("dark", pictures.darks),
    ):
        write_pictures(tmp_path, prefix, frames[:, :, ::-1])
    (tmp_path / "marker_.log").write_text(log_text(pictures))
    change(tmp_path, ("Correction=ON", "Correction=OFF"), ("Direction=CC", "Direction=CW"))
    require_the_same_volume(tps.load_scan(tmp_path), marked())


def test_a_renamed_folder_and_the_log_alone(folder):
    for file in folder.glob("marker_*"):
        file.rename(folder / file.name.replace("marker_", "other"))
    require_the_same_volume(tps.load_scan(folder / "other.log"), marked())


def test_the_optical_axis_is_counted_from_the_lowest_line(folder):
    """Lines above it, of 0.64 mm at the axis, are as many more that the volume has above the source's plane."""
    change(folder, ("(line)=  16", "(line)=  12"))
    scan = tps.load_scan(folder)
    option = scan.vol_geom["option"]
    assert (option["WindowMinZ"] + option["WindowMaxZ"]) / 2 == pytest.approx(4 * 0.64)


@pytest.mark.parametrize(("line", "above"), [(18, 0.0), (19, 0.0), (17, 1.5), (20, -1.5)])
def test_a_whole_number_does_not_tell_the_middle_of_an_even_number_of_lines(tmp_path, line, above):
    write_folder("skyscan", tmp_path / "even", marked_scan(6, 38, 9))
    change(tmp_path / "even", ("(line)=  18", f"(line)=  {line}"))
    option = tps.load_scan(tmp_path / "even").vol_geom["option"]
    assert (option["WindowMinZ"] + option["WindowMaxZ"]) / 2 == pytest.approx(above * 0.64, abs=1e-9)


def test_a_rolled_camera_is_said_and_undone_on_request(tmp_path):
    """The pictures of a camera that is turned by 3 degrees are those of the same geometry with roll=3."""
    change_to = {"roll": 3.0}
    write_folder("skyscan", tmp_path / "a", marked())
    change(tmp_path / "a", ("Rotation=0.00000", "Rotation=3.00000"))
    plain, rolled = tps.load_scan(tmp_path / "a"), tps.load_scan(tmp_path / "a", scanner=change_to)
    assert "rotation of 3 degrees is not undone" in guesses(plain)
    upright, turned = (scan.proj_geom["Vectors"][0] for scan in (plain, rolled))
    angle = np.deg2rad(3.0)
    # Counterclockwise for one who looks along +y, x to the right and z up, about the detector's own middle.
    np.testing.assert_allclose(turned[6:9], 1.6 * np.array([np.cos(angle), 0, np.sin(angle)]), atol=1e-9)
    np.testing.assert_allclose(turned[9:], 1.6 * np.array([-np.sin(angle), 0, np.cos(angle)]), atol=1e-9)
    np.testing.assert_allclose(turned[:6], upright[:6], atol=1e-9)


def test_what_the_log_leaves_open_is_said(folder):
    change(
        folder,
        ("Postalignment=-1.50", "Postalignment=0"),
        ("Reference Intensity=57000", ""),
        ("Rotation Direction=CC", ""),
        ("X/Y Ratio=1.0000", "X/Y Ratio=1.0740"),
        ("Filter=Al 1.0mm", "Filter=something"),
        ("Files=  48", "Files=  50"),
    )
    scan = tps.load_scan(folder)
    for words in (
        "no Postalignment",
        "no flat field: the open beam is taken to be 57",
        "taken to be CC",
        "1.074 times as wide as high",
        "its filter is not known",
        "48 pictures are there, the log tells of 50",
    ):
        assert words in guesses(scan)
    assert scan.spectrum is None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "Rows=  33",
            "Rows=  512",
            "pictures of 512 x 37 pixels, as the log says, got 33 x 37; reconstructed slices",
        ),
        ("Object to Source (mm)=100.000", "Object to Source (mm)=far", "a number as 'Object to Source"),
        ("Camera to Source (mm)=250.000", "Camera to Source (mm)=50", "at least source_object"),
        ("Step (deg)=7.500", "Step (deg)=0.000", None),  # a full turn
        ("Step (deg)=7.500\nUse 360 Rotation=YES", "Use 360 Rotation=NO", "Rotation Step .deg.: expected"),
        ("Prefix=marker_", "Prefix=no", None),
    ],
)
def test_logs_that_cannot_be_meant(folder, old, new, message):
    change(folder, (old, new))
    if message is None:  # what is missing, such as which pictures are meant, is told otherwise
        write_folder("skyscan", folder.parent / "untouched", marked())
        expected = tps.load_scan(folder.parent / "untouched")
        found = tps.load_scan(folder)
        np.testing.assert_allclose(found.proj_geom["Vectors"], expected.proj_geom["Vectors"], atol=1e-9)
        return
    with pytest.raises(ValueError, match=message):
        tps.load_scan(folder)


def test_two_scans_in_a_folder_are_to_be_named(folder):
    (folder / "second.log").write_text((folder / "marker_.log").read_text())
    with pytest.raises(
        ValueError, match=r"one scan in the folder, got marker_.log, second.log; name its .log"
    ):
        tps.load_scan(folder)
    assert tps.load_scan(folder / "marker_.log").views == 48


def test_pictures_of_another_size_in_between(folder):
    tifffile.imwrite(folder / "marker_0007.tif", np.ones((3, 4), np.uint16))
    with pytest.raises(ValueError, match=r"\(33, 37\) as in marker_0000.tif"):
        tps.load_scan(folder)


@pytest.mark.parametrize(
    ("text", "filters"),
    [
        ("Al 1.0mm", {"Al": 0.1}),
        ("Al 1mm", {"Al": 0.1}),
        ("0.5 mm Cu", {"Cu": 0.05}),
        ("Al 0.5mm + Cu 0.038mm", {"Al": 0.05, "Cu": 0.0038}),
        ("brass 250um", {"brass": 0.025}),
        ("Al 0,5mm", {"Al": 0.05}),
        ("Al 500 \u00b5m", {"Al": 0.05}),
        ("Al 500 \u03bcm", {"Al": 0.05}),
        ("Al 0.5mm / Cu 0.038mm", {"Al": 0.05, "Cu": 0.0038}),
        ("Al 0,5mm, Cu 0,04 mm filter", {"Al": 0.05, "Cu": 0.004}),
        ("Al (0.5mm)", {"Al": 0.05}),
        ("No Filter", {}),
        ("", {}),
        ("Al+Cu", None),
        ("LE4", None),
        ("Al 1", None),
    ],
)
def test_filters_as_scanners_write_them(text, filters):
    found = filters_of(text)
    assert found == (None if filters is None else pytest.approx(filters))


def written_again(folder, replace, encoding="utf-8"):
    log = folder / "marker_.log"
    log.write_bytes(replace(log.read_bytes().decode("utf-8")).encode(encoding))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "cp1252", "utf-16"])
def test_logs_of_another_country_say_the_same(folder, encoding):
    """Decimal commas, and paths of letters that are not ASCII, in what a Windows program may write."""
    exact = tps.load_scan(folder)
    written_again(
        folder, lambda text: text.replace(".", ",").replace("[Acq", "User=Núria µ\r\n[Acq"), encoding
    )
    scan = tps.load_scan(folder)
    np.testing.assert_array_equal(scan.proj_geom["Vectors"], exact.proj_geom["Vectors"])
    assert scan.notes["scanner"]["tube_kv"] == "90.0" and scan.notes["scanner"]["filter"] == "1 mm Al"
    assert scan.notes["scanner"]["keys"]["System/User"] == "Núria µ"


def test_numbers_with_two_signs_are_none(folder):
    change(folder, ("Object to Source (mm)=100.000", "Object to Source (mm)=1,100.5"))
    with pytest.raises(ValueError, match="a number as 'Object to Source"):
        tps.load_scan(folder)


def test_pictures_with_capital_endings_eight_digits_and_some_missing(folder):
    change(folder, ("Index Length=4", "Index Length=8"))
    even = tps.load_scan(folder)  # the log is wrong about the digits
    for file in folder.glob("marker_*.tif"):
        if (number := file.stem.split("_")[-1]) != "spr0":
            file.rename(folder / f"marker_{int(number):08d}.TIF")
    for k in (7, 8):
        (folder / f"marker_{k:08d}.TIF").unlink()
    scan = tps.load_scan(folder)
    left = np.delete(np.arange(48), [7, 8])
    np.testing.assert_allclose(scan.proj_geom["Vectors"], even.proj_geom["Vectors"][left], atol=1e-9)
    assert "jump (6 to 9)" in guesses(scan) and "46 pictures are there" in guesses(scan)


@pytest.mark.parametrize("more", [1, 24])
def test_views_beyond_a_full_turn(folder, more):
    """A scanner that ends where it has begun takes one more picture than there are steps."""
    for k in range(more):
        (folder / f"marker_{48 + k:04d}.tif").write_bytes((folder / f"marker_{k:04d}.tif").read_bytes())
    change(folder, ("Files=  48", f"Files=  {48 + more}"))
    scan = tps.load_scan(folder)
    assert scan.views == 48 + more and len(scan.notes["scanner"]["guessed"]) == 1
    np.testing.assert_allclose(scan.proj_geom["Vectors"][48], scan.proj_geom["Vectors"][0], atol=1e-9)
    require_the_same_volume(scan, marked())


def test_the_log_of_a_reconstruction_beside_that_of_the_scan(folder):
    """NRecon writes a log with the axis' shift, which that of the scan may lack."""
    exact = tps.load_scan(folder)
    text = (folder / "marker_.log").read_text()
    (folder / "marker__rec.log").write_text(text + "[File name convention]\nFilename Prefix=marker__rec\n")
    change(folder, ("[Reconstruction]\nPostalignment=-1.50\n", ""))
    scan = tps.load_scan(folder)
    np.testing.assert_array_equal(scan.proj_geom["Vectors"], exact.proj_geom["Vectors"])
    with pytest.raises(
        ValueError, match="a scan, got .*the log of a reconstruction; name the folder of the proj"
    ):
        tps.load_scan(folder / "marker__rec.log")


def test_a_part_of_connected_scans(folder):
    """Its own shift of the axis stands in the log of them all, beside those of the parts."""
    exact = tps.load_scan(folder)
    for file in folder.glob("marker_0*.tif"):
        file.rename(folder / file.name.replace("marker_", "marker~01"))
    connected = "Number of connected scans=2\nCurrent scan number=2\n[Reconstruction]"
    change(folder, ("Prefix=marker_", "Prefix=marker~01"), ("[Reconstruction]", connected))
    text = (folder / "marker_.log").read_text()
    (folder / "marker~01.log").write_text(text.replace("Postalignment=-1.50\n", ""))
    own = text.replace("marker~01", "marker~00").replace("number=2", "number=1")
    shifts = "Sub-scan post alignment [0]=3.000000\nSub-scan post alignment [1]=-1.500000\n"
    (folder / "marker_.log").write_text(own.replace("Postalignment=-1.50\n", shifts))
    scan = tps.load_scan(folder / "marker~01.log")
    np.testing.assert_array_equal(scan.proj_geom["Vectors"], exact.proj_geom["Vectors"])
    assert "this is part 2 of 2 connected scans" in guesses(scan)


def test_pictures_that_have_moved_and_a_log_without_what_can_be_told_otherwise(folder):
    exact = tps.load_scan(folder)
    moved = "Maximum vertical TS=9.0\nTS modified according to=D:\\a b\\marker_TS.csv\n[Reconstruction]"
    change(folder, ("[Reconstruction]", moved), ("Image Pixel Size (um)=640.000000\n", ""))
    change(folder, ("Source Voltage (kV)=  90\n", ""))
    scan = tps.load_scan(folder)
    np.testing.assert_allclose(scan.proj_geom["Vectors"], exact.proj_geom["Vectors"], rtol=1e-6)
    for words in ("by at most 9.0 rows and ? columns (marker_TS.csv)", "no Image Pixel Size", "the voltage"):
        assert words in guesses(scan)
    assert scan.spectrum is None


def test_a_log_that_was_written_for_a_parallel_beam(tmp_path):
    """Users of beamlines and of optical tomography write logs for NRecon, with the source hundreds of metres away."""
    write_folder("skyscan", tmp_path / "light", marked("parallel"))
    change(
        tmp_path / "light",
        ("Object to Source (mm)=100.000", "Object to Source (mm)=1000000"),
        ("Camera to Source (mm)=250.000\n", ""),
    )
    scan = tps.load_scan(tmp_path / "light")
    assert scan.proj_geom["type"].startswith("parallel") and "taken to be parallel" in guesses(scan)
    require_the_same_volume(scan, marked("parallel"))


def test_the_camera_stands_where_its_pixel_tells(folder):
    """The log of an older scanner has the pixel of the camera and that in the object, and one of the distances."""
    exact = tps.load_scan(folder)
    change(folder, ("Camera to Source (mm)=250.000\n", ""))
    scan = tps.load_scan(folder)
    np.testing.assert_allclose(scan.proj_geom["Vectors"], exact.proj_geom["Vectors"], rtol=1e-6, atol=1e-9)
    change(folder, ("Camera Pixel Size (um)", "Camera Pixel"))
    with pytest.raises(ValueError, match="a number as 'Camera to Source"):
        tps.load_scan(folder)


def test_a_camera_that_was_offset_is_said_unless_its_pictures_were_put_together(folder):
    change(folder, ("Image Rotation=0.00000", "Camera Offset=ON"))
    assert "the camera was offset" in guesses(tps.load_scan(folder))
    change(folder, ("Camera Offset=ON", "Camera Offset=ON\nNumber Of Horizontal Offset Positions=2"))
    assert "the camera was offset" not in guesses(tps.load_scan(folder))
