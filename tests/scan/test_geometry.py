"""Geometry against ASTRA's own projection of points, and the laws that any geometry obeys."""

import numpy as np
import pytest
from geometry_scans import ANGLES, VOLUME, scan_2d, scan_3d

from tomo_polysplat.scan.geometry import (
    Geometry,
    from_astra,
    is_planar_geometry,
    to_astra,
    volume_from_astra,
    volume_to_astra,
)

astra = pytest.importorskip("astra")
pytest.importorskip("astra.experimental")  # not loaded by astra itself


def rotation(axis, angle):
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


@pytest.mark.parametrize("kind", ["parallel3d", "parallel3d_vec", "cone", "cone_vec"])
def test_points_fall_where_astra_says(kind):
    proj_geom = scan_3d(kind)
    geometry, _ = from_astra(proj_geom, VOLUME)
    points = np.random.default_rng(1).normal(size=(6, 3))
    expected = [
        [astra.experimental.projectPoint(proj_geom, *map(float, p), view) for p in points]
        for view in range(geometry.views)
    ]
    # ASTRA keeps angles in float32, vectors in float64.
    tolerance = 1e-10 if kind.endswith("_vec") else 5e-6
    np.testing.assert_allclose(geometry.project_points(points), expected, atol=tolerance)


@pytest.mark.parametrize("offset", [(2.25, 0.0), (-1.5, 3.75)])
def test_detector_offsets_made_by_astra(offset):
    plain = scan_3d("cone")
    moved = astra.geom_postalignment(plain, offset)
    points = np.random.default_rng(2).normal(size=(4, 3))
    before, after = (from_astra(g, VOLUME)[0].project_points(points) for g in (plain, moved))
    np.testing.assert_allclose(after, before - offset, atol=1e-10)


@pytest.mark.parametrize("kind", ["parallel", "parallel_vec", "fanflat", "fanflat_vec"])
def test_planar_scans_lie_at_z_0(kind):
    proj_geom = scan_2d(kind)
    geometry, grid = from_astra(proj_geom, astra.create_vol_geom(4, 5))
    assert geometry.planar
    assert grid.planar
    assert geometry.shape == (5, 1, 11)
    assert grid.shape == (1, 4, 5)
    # The same scan drawn in 3D, where ASTRA can be asked.
    if kind.startswith("fanflat"):
        spatial = astra.create_proj_geom("cone", 1.3, 1.3, 1, 11, ANGLES, 50.0, 30.0)
    else:
        spatial = astra.create_proj_geom("parallel3d", 1.3, 1.3, 1, 11, ANGLES)
    points = np.array([[0.7, -1.2, 0.0], [-2.0, 0.3, 0.0]])
    expected = [
        [astra.experimental.projectPoint(spatial, *map(float, p), view) for p in points] for view in range(5)
    ]
    np.testing.assert_allclose(geometry.project_points(points), expected, atol=5e-6)


def test_planar_orientation_agrees_with_astras_image():
    """A point in one corner of ASTRA's 2D image, whose row 0 is at +y, is on our rays to its shadow."""
    vol_geom = astra.create_vol_geom(16, 24, -8, 16, -5, 11)
    proj_geom = astra.create_proj_geom("fanflat", 1.0, 80, ANGLES, 60.0, 30.0)
    image = np.zeros((16, 24), np.float32)
    image[2, 19] = 1.0
    projector = astra.create_projector("line_fanflat", proj_geom, vol_geom)
    identifier, sinogram = astra.create_sino(image, projector)
    astra.data2d.delete(identifier)
    astra.projector.delete(projector)
    geometry, grid = from_astra(proj_geom, vol_geom)
    ours = volume_from_astra(image, vol_geom)
    iz, iy, ix = np.argwhere(ours)[0]
    x, y, z = grid.axes()
    column = geometry.project_points([[x[ix], y[iy], z[iz]]])[:, 0, 0]
    measured = (sinogram * np.arange(80)).sum(axis=1) / sinogram.sum(axis=1)
    np.testing.assert_allclose(column, measured, atol=0.3)
    np.testing.assert_array_equal(volume_to_astra(ours, vol_geom), image)


def test_planar_or_not():
    assert is_planar_geometry(scan_2d("parallel"))
    assert not is_planar_geometry(scan_3d("cone"))
    assert is_planar_geometry(astra.create_vol_geom(4, 5))
    assert not is_planar_geometry(VOLUME)
    assert not from_astra(scan_3d("cone"), VOLUME)[0].planar


def test_rays_pass_through_the_points_they_show():
    for kind in ("cone_vec", "parallel3d_vec"):
        geometry, _ = from_astra(scan_3d(kind), VOLUME)
        origins, directions = geometry.rays(3)
        assert origins.shape == directions.shape == (7, 12, 3)
        np.testing.assert_allclose(np.linalg.norm(directions, axis=2), 1.0)
        points = (origins + 41.0 * directions).reshape(-1, 3)
        rows, columns = np.mgrid[:7, :12]
        expected = np.stack([columns, rows], axis=-1).reshape(-1, 2)
        np.testing.assert_allclose(geometry.select([3]).project_points(points)[0], expected, atol=1e-9)


def test_a_point_behind_the_source_has_no_shadow():
    geometry, _ = from_astra(scan_3d("cone"), VOLUME)
    assert np.isnan(geometry.project_points(geometry.origin[:1] * 1.5)[0]).all()


def test_volume_window_defaults_and_anisotropy():
    bare = {"GridRowCount": 4, "GridColCount": 5, "GridSliceCount": 6, "option": {}}
    grid = from_astra(scan_3d("cone"), bare)[1]
    assert grid.shape == (6, 4, 5)
    np.testing.assert_array_equal(grid.voxel_size, 1.0)
    np.testing.assert_array_equal(grid.lower, [-2.5, -2.0, -3.0])
    window = astra.create_vol_geom(4, 5, 6, -1.0, 9.0, 0.0, 2.0, -3.0, 0.0)
    grid = from_astra(scan_3d("cone"), window)[1]
    np.testing.assert_allclose(grid.voxel_size, [2.0, 0.5, 0.5])
    np.testing.assert_allclose(grid.centre, [4.0, 1.0, -1.5])
    np.testing.assert_allclose(grid.axes()[0], [0, 2, 4, 6, 8])


@pytest.mark.parametrize("kind", ["cone_vec", "parallel3d_vec"])
def test_back_to_astra(kind):
    proj_geom = scan_3d(kind)
    again, vol_geom = to_astra(*from_astra(proj_geom, VOLUME))
    assert again["type"] == kind
    np.testing.assert_allclose(again["Vectors"], proj_geom["Vectors"], atol=1e-12)
    assert vol_geom == VOLUME


@pytest.mark.parametrize("kind", ["cone_vec", "parallel3d_vec"])
def test_moving_the_object_is_moving_the_scanner_back(kind):
    geometry, _ = from_astra(scan_3d(kind), VOLUME)
    turn, shift = rotation([1, -2, 0.5], 0.7), np.array([0.4, -1.1, 0.8])
    points = np.random.default_rng(3).normal(size=(8, 3))
    seen = geometry.shifted(-shift).project_points(points)
    np.testing.assert_allclose(seen, geometry.project_points(points + shift), atol=1e-10)
    origin, corner = geometry.origin @ turn, geometry.corner @ turn  # rows times R = R^-1 of each vector
    turned = Geometry(geometry.beam, origin, corner, geometry.u @ turn, geometry.v @ turn, 7, 12)
    seen = turned.project_points(points)
    np.testing.assert_allclose(seen, geometry.project_points(points @ turn.T), atol=1e-10)


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_unit_of_length_is_free(factor):
    for kind in ("cone_vec", "parallel3d_vec"):
        geometry, grid = from_astra(scan_3d(kind), VOLUME)
        points = np.random.default_rng(4).normal(size=(8, 3))
        seen = geometry.scaled(factor).project_points(points * factor)
        np.testing.assert_allclose(seen, geometry.project_points(points), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(grid.scaled(factor).voxel_size, grid.voxel_size * factor)
        centre = np.array([0.3, -0.2, 0.9])
        seen = geometry.normalised(centre, 7.0).project_points((points - centre) / 7.0)
        np.testing.assert_allclose(seen, geometry.project_points(points), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(grid.normalised(centre, 7.0).centre, (grid.centre - centre) / 7.0)


def test_a_farther_and_larger_detector_sees_the_same():
    near = from_astra(astra.create_proj_geom("cone", 1.0, 2.0, 7, 11, ANGLES, 50.0, 25.0), VOLUME)[0]
    far = from_astra(astra.create_proj_geom("cone", 2.0, 4.0, 7, 11, ANGLES, 50.0, 100.0), VOLUME)[0]
    points = np.random.default_rng(5).normal(size=(8, 3))
    np.testing.assert_allclose(near.project_points(points), far.project_points(points), atol=1e-10)
    np.testing.assert_allclose(near.magnification(np.zeros(3)), 1.5)
    np.testing.assert_allclose(far.pixel_size_at(np.zeros(3)), (2.0 / 3.0, 4.0 / 3.0))


@pytest.mark.parametrize("factor", [2, 3])
def test_binning_moves_pixel_centres_to_the_mean(factor):
    geometry, _ = from_astra(scan_3d("cone_vec"), VOLUME)
    coarse = geometry.binned(factor)
    assert (coarse.rows, coarse.columns) == (7 // factor, 12 // factor)
    points = np.random.default_rng(6).normal(size=(8, 3))
    fine = geometry.project_points(points)
    np.testing.assert_allclose(coarse.project_points(points), (fine + 0.5) / factor - 0.5, atol=1e-10)
    row = from_astra(scan_2d("fanflat"), astra.create_vol_geom(4, 5))[0].binned(2)
    assert row.shape == (5, 1, 5)
    assert row.planar
    apart = geometry.binned(factor, 1)
    assert (apart.rows, apart.columns) == (7, 12 // factor)
    expected = (fine + 0.5) / (factor, 1) - 0.5
    np.testing.assert_allclose(apart.project_points(points), expected, atol=1e-10)
    for factors in ((8,), (13, 1), (1, 8)):
        with pytest.raises(ValueError, match="binning factor"):
            geometry.binned(*factors)


def test_a_geometry_is_a_value():
    proj_geom = scan_3d("cone_vec")
    geometry, _ = from_astra(proj_geom, VOLUME)
    before = geometry.origin.copy()
    proj_geom["Vectors"][:] = 0
    np.testing.assert_array_equal(geometry.origin, before)
    with pytest.raises(ValueError, match="read-only"):
        geometry.origin[0, 0] = 1.0
    assert "5 views of 7 x 12 pixels" in geometry.describe()
