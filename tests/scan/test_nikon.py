"""A Nikon's folder: the axis, the measured angles, and what is left open."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import tomo_polysplat as tps
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.simulate.folders.write import write_folder


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    path = tmp_path_factory.mktemp("nikon") / "sample"
    write_folder("nikon", path)
    return path


@pytest.fixture
def folder(sound, tmp_path):
    """A copy to change."""
    return Path(shutil.copytree(sound, tmp_path / "sample"))


def change(folder, *pairs):
    text = (folder / "marker.xtekct").read_text()
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    (folder / "marker.xtekct").write_text(text)


def source_degrees(scan):
    vectors = scan.proj_geom["Vectors"]
    return np.rad2deg(np.unwrap(np.arctan2(vectors[:, 0], -vectors[:, 1])))


def test_what_the_text_tells(folder):
    scan = tps.load_scan(folder)
    told = scan.notes["scanner"]
    assert (told["tube_kv"], told["filter"], scan.name) == ("90.0", "1 mm Aluminium", "marker")
    assert scan.valid is None and told["keys"]["Xrays/XrayuA"] == "100" and len(told["guessed"]) == 1


def test_the_axis_by_two_points_is_that_of_the_object(folder):
    """On the detector the axis stands as far off as the turntable, magnified."""
    aside = tps.load_scan(folder)
    change(
        folder,
        ("ObjectOffsetX=0.9\n", ""),
        ("ObjectRoll=0\n", ""),
        ("CentreOfRotationTop=0.0", "CentreOfRotationTop=2.25"),
        ("CentreOfRotationBottom=0.0", "CentreOfRotationBottom=2.25"),
    )
    by_points = tps.load_scan(folder)
    np.testing.assert_allclose(by_points.proj_geom["Vectors"], aside.proj_geom["Vectors"], atol=1e-9)
    change(folder, ("CentreOfRotationTop=2.25", "CentreOfRotationTop=2.75"))
    u = tps.load_scan(folder).proj_geom["Vectors"][0, 6:9]
    # Half a mm over 33 rows of 1.6 mm, and the axis leans to the left of who looks from the source.
    assert np.arctan2(u[2], u[0]) == pytest.approx(-np.arctan2(0.5, 33 * 1.6))


def test_measured_angles_are_taken_where_they_are_not_even(folder):
    even = np.arange(48) * 7.5
    measured = even + np.where(np.arange(48) > 20, 2.0, 0.0)
    lines = "\n".join(f"{k + 1}\t{angle:.3f}\t0" for k, angle in enumerate(measured))
    (folder / "_ctdata.txt").write_text(f"head\n\nProjection\tAngle(deg)\tTime(s)\n{lines}\n")
    found = source_degrees(tps.load_scan(folder))
    np.testing.assert_allclose(found - found[0], measured, atol=1e-3)
    # An .ang file counts the other way round: the sense is that of the step.
    (folder / "_ctdata.txt").unlink()
    (folder / "marker.ang").write_text(
        "\n".join(f"{k + 1}:\t{-angle:.3f}" for k, angle in enumerate(measured))
    )
    found = source_degrees(tps.load_scan(folder))
    np.testing.assert_allclose(found - found[0], measured, atol=1e-3)


def test_what_is_guessed_is_said(folder):
    change(
        folder,
        ("Projections=48", "Projections=60"),
        ("WhiteLevel=60000.0", ""),
    )
    guesses = " | ".join(tps.load_scan(folder).notes["scanner"]["guessed"])
    for words in (
        "48 pictures are there, the .xtekct tells of 60",
        "no flat field",
    ):
        assert words in guesses


def test_a_text_without_distances_is_refused(folder):
    change(folder, ("SrcToObject=100.0", ""))
    with pytest.raises(ValueError, match="a number as 'SrcToObject' in marker.xtekct, got none"):
        tps.load_scan(folder)


def test_the_marker_s_ray_through_the_moved_turntable(folder):
    """The axis falls to the left of the detector's middle, by its distance and magnification."""
    scan = tps.load_scan(folder)
    geometry, _ = from_astra(scan.proj_geom, scan.vol_geom)
    column = geometry.project_points(np.zeros((1, 3)))[:, 0, 0]
    np.testing.assert_allclose(column, 18 - 0.9 * 2.5 / 1.6)


def test_a_detector_that_was_moved_and_an_axis_that_leans_towards_it(folder):
    """As the reader of the Core Imaging Library puts them: by minus the offset in x, by it in z; the axis' top in y."""
    change(
        folder,
        ("ObjectOffsetX=0.9", "ObjectOffsetX=0"),
        ("ObjectTilt=0", "ObjectTilt=3"),
        ("DetectorOffsetX=0", "DetectorOffsetX=3.2"),
        ("DetectorOffsetY=0", "DetectorOffsetY=1.6"),
    )
    scan = tps.load_scan(folder)
    geometry, _ = from_astra(scan.proj_geom, scan.vol_geom)
    lean = np.deg2rad(3.0)
    for height in (0.0, 10.0):
        column, row = geometry.project_points(np.array([[0.0, 0.0, height]]))[:, 0].T
        up = height * np.cos(lean) * 250 / (100 + height * np.sin(lean))
        np.testing.assert_allclose(column, 18 + 3.2 / 1.6, atol=1e-6)
        np.testing.assert_allclose(row, 16 + (up - 1.6) / 1.6, atol=1e-6)


def test_missing_pictures_keep_the_angles_of_the_others(folder):
    even = source_degrees(tps.load_scan(folder))
    left = np.delete(np.arange(48), [0, 6, 7])
    for k in (1, 7, 8):
        (folder / f"marker_{k:04d}.tif").unlink()
    found = source_degrees(scan := tps.load_scan(folder))
    np.testing.assert_allclose(found - found[0], even[left] - even[1], atol=1e-4)
    assert "jump (6 to 9)" in " | ".join(scan.notes["scanner"]["guessed"])


def test_a_head_of_numbers_above_the_angles_and_another_country_s_decimal_sign(folder):
    """The head of a _ctdata.txt has a line of numbers; angles may be counted modulo 360."""
    measured = np.arange(48) * 7.5 + np.where(np.arange(48) > 20, 2.0, 0.0)
    lines = [f"{k + 1}\t{(angle + 300) % 360:.3f}\t{k}" for k, angle in enumerate(measured)]
    head = ["Projs\tFrames\tExposure(ms)", "48\t1\t1000", "Projection\tAngle(deg)\tTime(s)"]
    (folder / "_CTDATA.TXT").write_text("\r\n".join([*head, *lines, ""]).replace(".", ","), newline="")
    found = source_degrees(tps.load_scan(folder))
    np.testing.assert_allclose(found - found[0], measured, atol=2e-3)


def test_texts_of_another_country(folder):
    """Decimal commas, Windows' line ends and its Western encoding say the same."""
    exact = tps.load_scan(folder)
    text = (folder / "marker.xtekct").read_text().replace(".", ",").replace("[CTPro]", "[CTPro]\nBy=Núria µ")
    (folder / "marker.xtekct").write_bytes(text.replace("\n", "\r\n").encode("cp1252"))
    scan = tps.load_scan(folder)
    np.testing.assert_array_equal(scan.proj_geom["Vectors"], exact.proj_geom["Vectors"])
    assert scan.notes["scanner"]["filter"] == "1 mm Aluminium"
    assert scan.notes["scanner"]["keys"]["CTPro/By"] == "Núria µ"


@pytest.mark.parametrize(
    ("material", "thickness", "filters", "said"),
    [
        ("", "0.000", "no filter", ""),  # as Inspect-X writes it without a filter
        ("None", "", "no filter", ""),
        ("Copper", "0.125", "0.125 mm Copper", ""),
        ("Copper", "", "not known", "a filter of Copper without its thickness"),
    ],
)
def test_filters_as_the_scanner_writes_them(folder, material, thickness, filters, said):
    change(
        folder,
        ("Filter_ThicknessMM=1.000", f"Filter_ThicknessMM={thickness}"),
        ("Filter_Material=Aluminium", f"Filter_Material={material}"),
    )
    told = tps.load_scan(folder).notes["scanner"]
    assert told.get("filter", "not known") == filters
    assert said in " | ".join(told["guessed"])


def test_pictures_that_were_binned_or_cut_out_afterwards_are_refused(folder):
    """Half of the pixels in a picture of the same name would make everything half as large, in silence."""
    change(folder, ("DetectorPixelsX=37", "DetectorPixelsX=74"), ("DetectorPixelsY=33", "DetectorPixelsY=66"))
    with pytest.raises(
        ValueError, match="pictures of 66 x 74 pixels, as DetectorPixelsY .* got 33 x 37; write"
    ):
        tps.load_scan(folder)


def test_the_text_beside_a_folder_of_the_pictures(folder):
    """Where InputFolderName is empty, because somebody sorted the files."""
    expected = np.asarray(tps.load_scan(folder).projections)
    (folder / "projections").mkdir()
    for file in folder.glob("*.tif"):
        file.rename(folder / "projections" / file.name)
    np.testing.assert_array_equal(tps.load_scan(folder).projections, expected)


def test_a_toml_file_beside_stands_over_the_text(folder):
    assert "no centre of rotation" not in " ".join(tps.load_scan(folder).notes["scanner"]["guessed"])
    change(folder, ("ObjectOffsetX", "IgnoredOffsetX"))
    assert "no centre of rotation" in " ".join(tps.load_scan(folder).notes["scanner"]["guessed"])
    (folder / "scan.toml").write_text(
        'offset = [1.5, 0.0]\nkvp = 120\nfilter = "Cu 0.5mm"\noperator = "me"\n'
    )
    scan = tps.load_scan(folder)
    told = scan.notes["scanner"]
    assert (told["tube_kv"], told["filter"], told["keys"]["operator"]) == ("120.0", "0.5 mm Cu", "me")
    assert "no centre of rotation" not in " ".join(told["guessed"])
    assert "scan.toml beside it is followed: offset, kvp, filter" in told["guessed"]
    stated = tps.load_scan(folder / "marker.xtekct", scanner={"offset": (1.5, 0.0)})
    np.testing.assert_array_equal(stated.proj_geom["Vectors"], scan.proj_geom["Vectors"])
    assert tps.load_scan(folder, scanner={"kvp": 100}).notes["scanner"]["tube_kv"] == "100.0"
    (folder / "scan.toml").write_text('filters = "Cu 0.5mm"\n')
    with pytest.raises(ValueError, match=r"scan.toml.*'filters'"):
        tps.load_scan(folder)


def test_a_picture_of_the_screen_is_no_view(folder):
    expected = tps.load_scan(folder)
    pictures = [file for file in folder.glob("*.tif")]
    (folder / "views").mkdir()
    for file in pictures:
        file.rename(folder / "views" / file.name)
    change(folder, ("Name=marker", "InputFolderName=C:\\scans\\views\nName=marker"))
    (folder / "Screenshot 1.tif").write_bytes((folder / "views" / pictures[0].name).read_bytes())
    np.testing.assert_array_equal(tps.load_scan(folder).projections, expected.projections)
