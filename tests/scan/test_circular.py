"""Geometries from distances, pixel and angles: against ASTRA's own projection of points, and laws of magnification."""

import astra
import numpy as np
import pytest
from astra.experimental import projectPoint

import tomo_polysplat as tps
from tomo_polysplat.scan.geometry import from_astra

SOD, SDD, PIXEL = 200.0, 500.0, 0.5
KNOWN = {"source_object": SOD, "source_detector": SDD, "pixel": PIXEL, "detector": (31, 41)}
DEGREES = np.arange(8) * 45.0


def test_points_fall_where_astra_says_and_where_magnification_puts_them():
    proj_geom, _ = tps.cone_geometry(**KNOWN, degrees=DEGREES)
    at_rest = astra.create_proj_geom("cone", PIXEL, PIXEL, 31, 41, np.deg2rad(DEGREES), SOD, SDD - SOD)
    geometry, _ = from_astra(proj_geom, astra.create_vol_geom(4, 4, 4))
    point = np.array([[3.0, 2.0, 1.0]])
    for view in range(8):
        there = projectPoint(at_rest, *point[0], view)
        np.testing.assert_allclose(geometry.project_points(point)[view, 0], there, atol=1e-4)
    # At 0 degrees the source is at -y: x runs with the columns, magnified by the distances.
    column, row = geometry.project_points(np.array([[3.0, 0.0, 1.0]]))[0, 0]
    assert column == pytest.approx(20 + 3.0 * SDD / SOD / PIXEL)
    assert row == pytest.approx(15 + 1.0 * SDD / SOD / PIXEL)


def test_the_voxel_is_the_pixel_brought_down_to_the_axis():
    _, vol_geom = tps.cone_geometry(**KNOWN, degrees=DEGREES)
    scan = from_astra(tps.cone_geometry(**KNOWN, degrees=DEGREES)[0], vol_geom)[1]
    assert scan.shape == (31, 41, 41)
    np.testing.assert_allclose(scan.voxel_size, PIXEL * SOD / SDD)
    np.testing.assert_allclose(scan.centre, 0, atol=1e-12)


@pytest.mark.parametrize("make", ["cone", "parallel"])
def test_an_offset_moves_the_detector_along_its_columns_and_rows(make):
    offset = (3.5, -2.0)
    known = KNOWN if make == "cone" else {"pixel": PIXEL, "detector": (31, 41)}
    build = tps.cone_geometry if make == "cone" else tps.parallel_geometry
    geometry, grid = from_astra(*build(**known, radians=np.deg2rad(DEGREES), offset=offset))
    # The axis appears as far from the middle as the detector was moved, to the other side.
    columns = geometry.project_points(np.zeros((1, 3)))[:, 0]
    np.testing.assert_allclose(columns, [[20 - 3.5 / PIXEL, 15 + 2.0 / PIXEL]] * 8)
    # The volume is at the height that the detector sees.
    magnification = SDD / SOD if make == "cone" else 1.0
    np.testing.assert_allclose(grid.centre, [0, 0, -2.0 / magnification], atol=1e-12)


def test_scale_alone_changes_nothing():
    small = from_astra(*tps.cone_geometry(**KNOWN, degrees=DEGREES, offset=(1.0, 2.0)))
    lengths = {"source_object": SOD, "source_detector": SDD, "pixel": PIXEL}
    large = from_astra(
        *tps.cone_geometry(
            **{name: 1000 * value for name, value in lengths.items()},
            detector=(31, 41),
            degrees=DEGREES,
            offset=(1000.0, 2000.0),
        )
    )
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(small[0].project_points(points), large[0].project_points(1000 * points))
    np.testing.assert_allclose(1000 * small[1].lower, large[1].lower)


def test_voxels_and_their_size_as_asked_for():
    for asked, shape in ((12, (12, 12, 12)), ((3, 4, 5), (3, 4, 5))):
        grid = from_astra(*tps.cone_geometry(**KNOWN, degrees=DEGREES, voxels=asked))[1]
        assert grid.shape == shape
        np.testing.assert_allclose(grid.voxel_size, PIXEL * SOD / SDD)
    # Twice as fine over the same field, and pixels that are not square leave the voxels cubes.
    fine = from_astra(*tps.cone_geometry(**KNOWN, degrees=DEGREES, voxel=0.1))[1]
    assert fine.shape == (62, 82, 82)
    high = from_astra(*tps.cone_geometry(**KNOWN | {"pixel": (0.5, 1.0)}, degrees=DEGREES))[1]
    assert high.shape == (62, 41, 41) and np.ptp(high.voxel_size) < 1e-12


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"source_detector": 100.0}, "source_detector: expected at least source_object, 200, got 100"),
        ({"degrees": None}, "degrees, radians: .* got neither"),
        ({"radians": DEGREES}, "degrees, radians: .* got both"),
        ({"degrees": None, "radians": DEGREES}, "radians, got 0 to 315, which look like degrees"),
        ({"degrees": [0.0, np.nan]}, "degrees: expected finite angles"),
        ({"detector": 31}, r"detector: expected 2 numbers \(rows, columns\), got 31"),
        ({"offset": 1.0}, r"offset: expected 2 numbers \(u, v\)"),
        ({"pixel": 0.0}, "pixel: expected a finite number > 0"),
        ({"voxels": (3, 4)}, r"voxels: expected 3 numbers \(nz, ny, nx\)"),
        ({"voxel": -1.0}, "voxel: expected a finite number > 0"),
    ],
)
def test_what_does_not_fit_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        tps.cone_geometry(**KNOWN | {"degrees": DEGREES} | change)


def test_radians_given_as_degrees_are_warned_of(caplog):
    tps.cone_geometry(**KNOWN, degrees=np.deg2rad(DEGREES))
    assert "are these radians?" in caplog.text
