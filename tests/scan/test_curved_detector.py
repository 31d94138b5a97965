"""A curved detector resampled to a flat one: where ASTRA's own projection of points says."""

import numpy as np
import pytest
from geometry_scans import ANGLES, VOLUME

from tomo_polysplat.scan.curved_detector import flat_geometry, flatten_projections
from tomo_polysplat.scan.geometry import from_astra, projections_from_astra

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
