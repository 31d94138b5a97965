"""A curved detector resampled to a flat one: where ASTRA's own projection of points says."""

import numpy as np
import pytest
from geometry_scans import ANGLES, VOLUME

import tomo_polysplat as tps
from tomo_polysplat.scan.check import check_scan
from tomo_polysplat.scan.curved_detector import flat_geometry, flatten_projections
from tomo_polysplat.scan.geometry import from_astra, projections_from_astra
from tomo_polysplat.scan.mending import mend_scan
from tomo_polysplat.scan.usable import usable_rays

astra = pytest.importorskip("astra")
pytest.importorskip("astra.experimental")  # not loaded by astra itself


def curved_scan(radius, shift=(0.0, 0.0)):
    plain = astra.create_proj_geom("cone", 1.0, 1.0, 9, 41, ANGLES[:2], 60.0, 30.0)
    vectors = astra.geom_2vec(astra.geom_postalignment(plain, shift))["Vectors"]
    vectors = np.column_stack([vectors, np.full(2, radius)])
    return astra.create_proj_geom("cyl_cone_vec", 9, 41, vectors)


@pytest.mark.parametrize(("radius", "shift"), [(90.0, (0.0, 0.0)), (60.0, (6.0, 2.0)), (1e6, (0.0, 0.0))])
def test_a_curved_detector_becomes_flat(radius, shift):
    """Resampled column and row numbers are those that ASTRA gives for points on the flat rays."""
    proj_geom = curved_scan(radius, shift)
    geometry, _ = from_astra(proj_geom, VOLUME)
    rows, columns = np.mgrid[:9, :41].astype(np.float32)
    for index, image in ((0, columns), (1, rows)):
        given = np.repeat(image[:, None], 2, axis=1)
        flat = projections_from_astra(given, proj_geom)
        assert flat.shape == geometry.shape
        covered = np.isfinite(flat)
        assert covered.mean() > 0.75
        for view in range(2):
            origins, directions = geometry.rays(view)
            points = (origins + 70.0 * directions)[covered[view]]
            expected = [
                astra.experimental.projectPoint(proj_geom, *map(float, p), view)[index] for p in points
            ]
            np.testing.assert_allclose(flat[view][covered[view]], expected, atol=2e-5)


@pytest.mark.parametrize(("radius", "column"), [(90.0, 8), (60.0, 3), (45.0, 33), (1e6, 12)])
@pytest.mark.parametrize("kind", [bool, np.uint8, float])
def test_what_is_not_valid_leaks_into_no_ray_that_is(radius, column, kind):
    """A flat ray between a good and a bad pixel is bad, however little it takes of the bad one."""
    proj_geom = curved_scan(radius, (1.3, 0.4))
    projections = np.ones((9, 2, 41), np.float32)
    valid = np.ones(projections.shape, kind) * (200 if kind is np.uint8 else 1)
    covered = np.isfinite(usable_rays(projections, proj_geom, None)[0]).sum()
    projections[:, :, column], valid[:, :, column] = 5000.0, 0
    projections[4, 1, 20], valid[4, 1, 20] = -7.0, 0
    values, counts, _ = usable_rays(projections, proj_geom, valid)
    usable = np.isfinite(values)
    np.testing.assert_allclose(values[usable], 1.0, rtol=1e-6)
    # Between neighbours of a column lie at most three of the flat detector, of a pixel nine.
    assert covered - 3 * 18 - 9 <= usable.sum() < covered
    assert counts["rays_out_of_range"] == 0


def test_the_flat_detector_takes_in_the_whole_curved_one():
    vectors = curved_scan(90.0)["Vectors"]
    vectors[:, 6:9] *= 2  # a fan of 48 degrees
    flat = flat_geometry(vectors, 9, 41)
    ramp = np.repeat(np.arange(41, dtype=np.float32)[None, None], 2, axis=0).repeat(9, axis=1)
    middle = flatten_projections(ramp, vectors)[:, 4]
    assert np.isfinite(middle).all()
    assert middle.min() < 1.0
    assert middle.max() > 39.0
    assert flat.columns > 41


def curved_ball():
    """A ball off the axis behind a wide fan, and the lengths of its chords, sampled where the curved pixels are."""
    radius, rows, columns, views = 50.0, 13, 44, 24
    angles = np.linspace(0, 2 * np.pi, views, endpoint=False)
    plain = astra.create_proj_geom("cone", 1.25, 1.5, rows, columns, angles, 25.0, 25.0)
    vectors = np.column_stack([astra.geom_2vec(plain)["Vectors"], np.full(views, radius)])
    source, middle, u, v = np.split(vectors[:, :12], 4, axis=1)
    arc = (np.arange(columns) - 0.5 * (columns - 1)) * np.linalg.norm(u[0]) / radius
    tangent, ahead = u / np.linalg.norm(u, axis=1)[:, None], (source - middle) / 50.0
    across = np.sin(arc)[None, :, None] * tangent[:, None] + (1 - np.cos(arc))[None, :, None] * ahead[:, None]
    up = (np.arange(rows) - 0.5 * (rows - 1))[None, :, None, None] * v[:, None, None]
    pixels = middle[:, None, None] + radius * across[:, None] + up
    ray = pixels - source[:, None, None]
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    off = source[:, None, None] - np.array([3.0, -2.0, 0.5])
    along = (off * ray).sum(-1)
    chord = 2 * np.sqrt(np.clip(along**2 - (off**2).sum(-1) + 5.0**2, 0, None))
    proj_geom = astra.create_proj_geom("cyl_cone_vec", rows, columns, vectors)
    volume = astra.create_vol_geom(24, 24, 9)
    return tps.Scan(0.1 * chord.swapaxes(0, 1).astype(np.float32), proj_geom, volume, unit="mm")


def test_the_axis_of_a_curved_detector_is_where_it_is():
    """A flat detector that holds the same shadow has more columns: its middle is not that of the array."""
    scan = curved_ball()
    (finding,) = [one for one in check_scan(scan) if one.probe == "centre"]
    assert finding.verdict == "ok" and abs(finding.values["offset"]) < 0.1
    assert mend_scan(scan) == (scan, [])


@pytest.mark.parametrize("part", [{"views": 2}, {"rows": (1, 12)}, {"columns": (2, 43)}, {"binning": 2}])
def test_a_part_of_a_curved_scan_has_its_rays_where_its_geometry_has_them(part, tmp_path):
    tps.save_scan(curved_ball(), tmp_path / "curved.npz")
    scan = tps.load_scan(tmp_path / "curved.npz", **part)
    assert scan.proj_geom["type"] == "cone_vec"
    geometry, _ = from_astra(scan.proj_geom, scan.vol_geom)
    for view in (0, 5):
        origins, rays = geometry.rays(view)
        off = origins - np.array([3.0, -2.0, 0.5])
        along = (off * rays).sum(-1)
        nearest = (off**2).sum(-1) - along**2
        chord = 2 * np.sqrt(np.clip(5.0**2 - nearest, 0, None))
        seen = scan.projections[:, view]
        inside = (nearest < 4.0**2) & np.isfinite(seen)
        assert inside.sum() > 5
        np.testing.assert_allclose(seen[inside], 0.1 * chord[inside], rtol=0.05)
