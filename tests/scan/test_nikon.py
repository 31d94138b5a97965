"""A Nikon's folder: the axis, the measured angles, and what is left open."""

import numpy as np
import pytest

import tomo_polysplat as tps
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.simulate.folders.write import write_folder


@pytest.fixture
def folder(tmp_path):
    write_folder("nikon", tmp_path / "sample")
    return tmp_path / "sample"


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


def test_what_is_not_used_is_said(folder):
    change(
        folder,
        ("ObjectTilt=0", "ObjectTilt=3"),
        ("Projections=48", "Projections=60"),
        ("WhiteLevel=60000.0", ""),
    )
    guesses = " | ".join(tps.load_scan(folder).notes["scanner"]["guessed"])
    for words in (
        "ObjectTilt = 3 is not used",
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
