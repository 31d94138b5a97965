"""RTK's geometries: against the matrices that RTK itself writes, and what does not fit."""

import re

import numpy as np
import pytest
import tifffile
from folders import marked, require_the_same_volume

import tomo_polysplat as tps
from tomo_polysplat.scan.readers.rtk import geometry_of
from tomo_polysplat.simulate.folders.scene import pictures_of
from tomo_polysplat.simulate.folders.write import write_folder

TABLE = {
    "SourceToIsocenterDistance": 1000.0,
    "SourceToDetectorDistance": 1536.0,
    "SourceOffsetX": 0.0,
    "SourceOffsetY": 0.0,
}


@pytest.fixture
def folder(tmp_path):
    write_folder("rtk", tmp_path / "sample", marked())
    return tmp_path / "sample"


def projected(table, points, size=(3, 5), origin=(-20.0, -10.0), spacing=(10.0, 10.0)):
    """Where points (x, y, z) of RTK's fall, in mm of its detector."""
    table = {name: np.array([value]) for name, value in table.items()}
    x, y, z = points.T
    fallen = geometry_of(table, size, origin, spacing).project_points(np.stack([x, -z, y], axis=1))[0]
    return np.array(origin) + fallen * np.array(spacing)


def test_points_fall_where_rtk_s_own_matrix_puts_them():
    """The view and its matrix are the example of RTK's documentation, of an Elekta scanner."""
    matrix = np.array(
        [
            [-166.5093078829, 0, -1531.42837748039, -117056.503295898],
            [-1.01142410874151, -1536, 0.0326206557691505, -1011.95001602173],
            [-0.999480303105996, 0, 0.0322354417240802, -1000],
        ]
    )
    view = {"GantryAngle": 271.847274780273, "OutOfPlaneAngle": 0.0, "InPlaneAngle": 0.0}
    view |= {"ProjectionOffsetX": -117.056503295898, "ProjectionOffsetY": -1.01195001602173}
    points = np.random.default_rng(2).uniform(-100, 100, (7, 3))
    u, v, w = matrix @ np.column_stack([points, np.ones(7)]).T
    np.testing.assert_allclose(projected(TABLE | view, points), np.stack([u / w, v / w], axis=1), atol=1e-6)


def test_angles_out_of_and_in_the_plane_are_turns_of_the_view():
    """Turned in the plane by 90 degrees, what was up is to the right; out of it, the source looks from below."""
    straight = {name: 0.0 for name in ("GantryAngle", "OutOfPlaneAngle", "InPlaneAngle")}
    view = TABLE | straight | {"ProjectionOffsetX": 0.0, "ProjectionOffsetY": 0.0}
    up = np.array([[0.0, 10.0, 0.0]])
    size = 10.0 * 1.536
    np.testing.assert_allclose(projected(view, up), [[0.0, size]], atol=1e-9)
    np.testing.assert_allclose(projected(view | {"InPlaneAngle": 90.0}, up), [[size, 0.0]], atol=1e-9)
    # Out of the plane by 90 degrees the source is at -y: a point between it and the axis falls on the middle.
    np.testing.assert_allclose(projected(view | {"OutOfPlaneAngle": 90.0}, -up), [[0.0, 0.0]], atol=1e-9)


def test_line_integrals_in_part(folder):
    whole = tps.load_scan(folder)
    np.testing.assert_allclose(whole.projections, marked().projections, atol=1e-3)
    # Rows count from the first in the file, which is the lowest.
    part = tps.load_scan(folder, rows=(2, 12), columns=(4, 30), views=5)
    np.testing.assert_array_equal(part.projections, whole.projections[2:12, ::5, 4:30])


def test_tiffs_of_counts_beside_a_geometry(folder):
    (folder / "projections.mha").unlink()
    pictures = pictures_of(marked())
    for name in ("projections", "flats", "darks"):
        tifffile.imwrite(folder / f"{name}.tif", getattr(pictures, name), photometric="minisblack")
    with pytest.raises(ValueError, match="pixel: expected the side of a pixel"):
        tps.load_scan(folder)
    stated = {"pixel": 1.6, "flats": "flats.tif", "darks": "darks.tif", "first_row": "top"}
    require_the_same_volume(tps.load_scan(folder, scanner=stated), marked())


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "<ProjectionOffsetX>2.4",
            "<RadiusCylindricalDetector>9</RadiusCylindricalDetector><ProjectionOffsetX>2.4",
            "flat",
        ),
        (
            "<GantryAngle>0.0</GantryAngle>",
            "<GantryAngle>first</GantryAngle>",
            "GantryAngle: expected a number",
        ),
        ("</RTKThreeDCircularGeometry>", "", "expected XML"),
        ("<!DOCTYPE RTKGEOMETRY>", '<!DOCTYPE a [<!ENTITY b "c">]>', "a geometry as RTK writes it"),
        ("<SourceToDetectorDistance>250.0", "<SourceToDetectorDistance>0", "a cone beam"),
        ("<Projection>\n    <GantryAngle>0.0</GantryAngle>\n  </Projection>", "", "47 views for 48 pictures"),
    ],
)
def test_geometries_that_do_not_fit(folder, old, new, message):
    text = (folder / "geometry.xml").read_text()
    assert old in text
    (folder / "geometry.xml").write_text(text.replace(old, new, 1))
    with pytest.raises((ValueError, TypeError), match=message):
        tps.load_scan(folder)


def test_matrices_alone_are_no_angles(folder):
    text = (folder / "geometry.xml").read_text()
    (folder / "geometry.xml").write_text(
        re.sub("<GantryAngle>.*?</GantryAngle>", "<Matrix>1 0 0 0</Matrix>", text)
    )
    with pytest.raises(ValueError, match="the GantryAngle of each view, got none in"):
        tps.load_scan(folder)


def test_a_damaged_stack_is_refused(folder):
    content = (folder / "projections.mha").read_bytes()
    (folder / "projections.mha").write_bytes(content[:2000])
    with pytest.raises(ValueError, match="234432 bytes of numbers, got"):
        tps.load_scan(folder)


def test_distances_have_no_place_beside_a_geometry(folder):
    with pytest.raises(ValueError, match="source_object: expected nothing"):
        tps.load_scan(folder, scanner={"sod": 100.0})
