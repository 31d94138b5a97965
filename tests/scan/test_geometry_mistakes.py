"""Geometries and arrays that cannot be meant: what is wrong is named, with the way to mend it."""

import re

import numpy as np
import pytest
from geometry_scans import VOLUME, scan_2d, scan_3d

from tomo_polysplat.scan.geometry import VolumeGrid, from_astra, projections_from_astra, volume_from_astra

astra = pytest.importorskip("astra")


def test_projections_are_put_in_our_order():
    proj_geom = scan_3d("cone")
    given = np.arange(7 * 5 * 12, dtype=np.float64).reshape(7, 5, 12)
    ours = projections_from_astra(given, proj_geom)
    assert ours.dtype == np.float32
    assert ours.flags.c_contiguous
    np.testing.assert_array_equal(ours, given.transpose(1, 0, 2))
    planar = projections_from_astra(given[0, :, :11], scan_2d("fanflat"))
    np.testing.assert_array_equal(planar[:, 0], given[0, :, :11])


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ((5, 7, 12), "look like (views, rows, columns) where ASTRA wants (rows, views, columns)"),
        ((5, 7, 12), "use numpy.swapaxes(projections, 0, 1)"),
        ((12, 7, 5), "use numpy.transpose(projections, (1, 2, 0))"),
        ((7, 5, 13), "expected shape (7, 5, 12) (rows, views, columns), got (7, 5, 13)"),
        ((5, 12), "expected shape (7, 5, 12)"),
    ],
)
def test_a_wrong_order_is_named(shape, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        projections_from_astra(np.zeros(shape), scan_3d("cone"))


@pytest.mark.parametrize("order", [(5, 7, 12), (12, 7, 5), (12, 5, 7), (5, 12, 7), (7, 12, 5)])
def test_the_advice_about_the_order_works(order):
    wrong = np.zeros(order)
    with pytest.raises(ValueError, match="use numpy") as caught:
        projections_from_astra(wrong, scan_3d("cone"))
    advice = re.search(r"use (numpy\..*)$", str(caught.value)).group(1)
    assert eval(advice, {"numpy": np, "projections": wrong}).shape == (7, 5, 12)


def test_a_wrong_planar_order_is_named():
    with pytest.raises(ValueError, match="numpy.swapaxes"):
        projections_from_astra(np.zeros((11, 5)), scan_2d("parallel"))
    with pytest.raises(TypeError, match="real numbers"):
        projections_from_astra(np.zeros((5, 11), complex), scan_2d("parallel"))


@pytest.mark.parametrize(
    "degrees",
    [
        np.linspace(0, 180, 181),
        np.linspace(0, 360, 120, endpoint=False),
        np.linspace(-180, 180, 360, endpoint=False),
        np.linspace(0, 200, 401),
        np.arange(8) * 45.0,
    ],
)
def test_degrees_are_refused(degrees):
    proj_geom = astra.create_proj_geom("cone", 1.0, 1.0, 7, 11, degrees, 50.0, 30.0)
    with pytest.raises(ValueError, match="look like degrees.*numpy.deg2rad"):
        from_astra(proj_geom, VOLUME)


@pytest.mark.parametrize(
    "radians",
    [
        np.linspace(0, np.pi, 181),
        np.linspace(-2 * np.pi, 2 * np.pi, 100),
        np.linspace(0, 20 * np.pi, 1000, endpoint=False),
        np.arange(200) * np.deg2rad(111.246),
    ],
)
def test_radians_are_not_taken_for_degrees(radians):
    proj_geom = astra.create_proj_geom("cone", 1.0, 1.0, 7, 11, radians, 50.0, 30.0)
    assert from_astra(proj_geom, VOLUME)[0].views == len(radians)


def with_vectors(change):
    proj_geom = scan_3d("cone_vec")
    change(proj_geom["Vectors"])
    return proj_geom


def set_nan(vectors):
    vectors[2, 4] = np.nan


def zero_u(vectors):
    vectors[1, 6:9] = 0


def parallel_steps(vectors):
    vectors[:, 9:12] = -2 * vectors[:, 6:9]


def edge_on(vectors):
    vectors[:, 9:12] = vectors[:, 3:6] - vectors[:, 0:3]


def source_inside(vectors):
    vectors[3, 0:3] = (0.5, 0.5, 1.0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (set_nan, "Vectors: expected finite numbers"),
        (zero_u, "u: expected a vector of length > 0, got zero in 1 of 5 views, first in view 1"),
        (parallel_steps, "u and v: expected two different directions"),
        (edge_on, "detector: expected rays that cross its plane"),
        (source_inside, "source positions: expected all outside the volume, got 1 of 5"),
    ],
)
def test_broken_vectors_are_named(change, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        from_astra(with_vectors(change), VOLUME)


def test_other_mistakes_are_named():
    cone = scan_3d("cone")
    with pytest.raises(ValueError, match="vol_geom: expected a 3D one"):
        from_astra(cone, astra.create_vol_geom(4, 5))
    with pytest.raises(ValueError, match="vol_geom: expected a 2D one"):
        from_astra(scan_2d("parallel"), VOLUME)
    with pytest.raises(ValueError, match="minimum < maximum"):
        from_astra(cone, astra.create_vol_geom(4, 5, 6, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0))
    with pytest.raises(ValueError, match="whole number"):
        from_astra({**cone, "DetectorRowCount": 7.5}, VOLUME)
    with pytest.raises(ValueError, match="whole number"):
        from_astra(cone, {**VOLUME, "GridSliceCount": 0})
    with pytest.raises(ValueError, match="DistanceOriginSource"):
        from_astra({**cone, "DistanceOriginSource": -50.0}, VOLUME)
    with pytest.raises(ValueError, match="a matrix has no rays"):
        from_astra({"type": "sparse_matrix"}, VOLUME)
    with pytest.raises(TypeError, match="create_proj_geom"):
        from_astra(VOLUME["option"], VOLUME)
    with pytest.raises(ValueError, match=r"shape \(views, 12\)"):
        from_astra({**scan_3d("cone_vec"), "Vectors": np.zeros((5, 6))}, VOLUME)
    with pytest.raises(ValueError, match="volume: expected shape"):
        volume_from_astra(np.zeros((4, 5, 6)), VOLUME)


def test_counts_of_other_types_are_accepted():
    proj_geom = {**scan_3d("cone"), "DetectorRowCount": np.int64(7), "DetectorColCount": 12.0}
    geometry, _ = from_astra(proj_geom, VOLUME)
    assert (geometry.rows, geometry.columns) == (7, 12)
    assert isinstance(VolumeGrid((np.int64(2), 3, 4), np.zeros(3), np.ones(3)).shape[0], int)
