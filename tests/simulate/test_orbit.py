"""The geometries are ASTRA's, and so are the rays computed from them."""

import numpy as np
import pytest

from tomo_polysplat.simulate.orbit import circular_orbit, view_vectors

astra = pytest.importorskip("astra")
projectPoint = pytest.importorskip("astra.experimental").projectPoint

ANGLES = np.linspace(0, 2 * np.pi, 7, endpoint=False)


def same(ours, theirs):
    assert ours.keys() == theirs.keys()
    for key, value in theirs.items():
        if isinstance(value, dict):
            same(ours[key], value)
        elif isinstance(value, np.ndarray):
            np.testing.assert_allclose(ours[key], value, atol=1e-12)
        else:
            assert ours[key] == pytest.approx(value)


def astra_volume(grid):
    window = [grid["option"][f"Window{end}{axis}"] for axis in "XYZ" for end in ("Min", "Max")]
    return astra.create_vol_geom(grid["GridRowCount"], grid["GridColCount"], grid["GridSliceCount"], *window)


def test_cone():
    geom, grid = circular_orbit("cone", 2.0, 9, 11, 13, ANGLES)
    spacing = geom["DetectorSpacingX"], geom["DetectorSpacingY"]
    same(geom, astra.create_proj_geom("cone", *spacing, 11, 13, ANGLES, 10.0, 5.0))
    same(grid, astra_volume(grid))
    assert grid["GridSliceCount"] == 9 and grid["option"]["WindowMaxZ"] == 2.0


def test_parallel():
    geom, grid = circular_orbit("parallel", 2.0, 9, 11, 13, ANGLES)
    same(
        geom,
        astra.create_proj_geom(
            "parallel3d", geom["DetectorSpacingX"], geom["DetectorSpacingY"], 11, 13, ANGLES
        ),
    )
    same(grid, astra_volume(grid))


def test_fan_is_the_middle_row_of_a_cone():
    geom, grid = circular_orbit("fan", 2.0, 9, 11, 13, ANGLES)
    same(geom, astra.create_proj_geom("cone_vec", 1, 13, geom["Vectors"]))
    same(grid, astra_volume(grid))
    assert grid["GridSliceCount"] == 1
    assert grid["option"]["WindowMaxZ"] - grid["option"]["WindowMinZ"] == pytest.approx(4.0 / 9)
    fan, cone = view_vectors(geom)[1], view_vectors(circular_orbit("cone", 2.0, 9, 11, 13, ANGLES)[0])[1]
    np.testing.assert_allclose(fan[:, 1], cone[:, 1] + 5 * cone[:, 3], atol=1e-12)
    assert not fan[:, :3, 2].any()


@pytest.mark.parametrize("kind", ["cone", "parallel"])
def test_rays_are_those_of_astra(kind):
    geom, _ = circular_orbit(kind, 2.0, 9, 6, 8, ANGLES)
    vector_form = astra.geom_2vec(geom)
    for given in (geom, vector_form):
        cone, vectors = view_vectors(given)
        assert cone == (kind == "cone")
        theirs = vector_form["Vectors"].reshape(-1, 4, 3)
        np.testing.assert_allclose(vectors[:, [0, 2, 3]], theirs[:, [0, 2, 3]], atol=1e-12)
        point = vectors[:, 1] + 2 * vectors[:, 2] + 3 * vectors[:, 3]  # centre of pixel (row 3, column 2)
        for view in range(len(ANGLES)):
            middle = (point[view] + vectors[view, 0]) / 2 if cone else point[view] + 1.7 * vectors[view, 0]
            column, row = projectPoint(given, *middle, view)
            assert (column, row) == pytest.approx((2, 3), abs=1e-4)


@pytest.mark.parametrize("kind", ["cone", "parallel"])
def test_the_detector_sees_the_whole_volume(kind):
    geom, _ = circular_orbit(kind, 2.0, 9, 20, 20, np.linspace(0, 2 * np.pi, 60))
    for corner in np.array(np.meshgrid([-2, 2], [-2, 2], [-2, 2])).reshape(3, -1).T:
        for view in range(60):
            column, row = projectPoint(geom, *map(float, corner), view)
            assert -0.501 <= column <= 19.501 and -0.501 <= row <= 19.501


def test_unknown_geometry():
    with pytest.raises(ValueError, match="cone, parallel, fan"):
        circular_orbit("helical", 2.0, 9, 6, 8, ANGLES)
