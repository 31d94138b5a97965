"""In whatever order views come, the volume is the same."""

import astra
import numpy as np
import pytest
from small_scans import QUICK, cone, fan, reconstruct

import tomo_polysplat as tps


def mixed(scan, seed=3):
    """A random order of the views, the projections in it, and their geometry as vectors."""
    order = np.random.default_rng(seed).permutation(scan.views)
    proj_geom = astra.geom_2vec(scan.proj_geom)
    return order, scan.projections[:, order], proj_geom | {"Vectors": proj_geom["Vectors"][order]}


@pytest.mark.parametrize("make", [fan, cone, lambda: cone(18, 20, True)], ids=["fan", "cone", "few, metal"])
def test_the_order_of_the_views_does_not_matter(make):
    """Bit by bit, the start (over subsets of the views where they are few) and the record of the run too."""
    scan = make()
    order, projections, proj_geom = mixed(scan)
    one = reconstruct(scan, proj_geom=astra.geom_2vec(scan.proj_geom), align="auto")
    other = reconstruct(scan, projections, proj_geom, align="auto")
    assert np.array_equal(one.volume, other.volume) and one.counts == other.counts
    assert one.plan == other.plan
    assert [r["held_out"] for r in one.history] == [r["held_out"] for r in other.history]


def test_valid_goes_with_its_views():
    scan = fan()
    order, projections, proj_geom = mixed(scan)
    valid = np.ones(scan.projections.shape, bool)
    valid[0, 4, 20:30] = valid[0, 11] = False
    one = reconstruct(scan, proj_geom=astra.geom_2vec(scan.proj_geom), valid=valid)
    other = reconstruct(scan, projections, proj_geom, valid=valid[:, order])
    assert np.array_equal(one.volume, other.volume) and one.counts == other.counts
    assert not np.array_equal(one.volume, reconstruct(scan, projections, proj_geom, valid=valid).volume)


def test_a_run_goes_on_with_the_views_in_another_order(tmp_path):
    """The file is one of the same scan."""
    scan, path = fan(), tmp_path / "fit.npz"
    _, projections, proj_geom = mixed(scan)
    settings = QUICK | {"passes": 4.0}
    whole = reconstruct(scan, proj_geom=astra.geom_2vec(scan.proj_geom), settings=settings)

    def stop(state):
        raise RuntimeError("out of memory")

    with pytest.raises(RuntimeError):
        reconstruct(
            scan,
            proj_geom=astra.geom_2vec(scan.proj_geom),
            settings=settings,
            checkpoint=path,
            callbacks=[lambda state: state.iteration > 5 and stop(state)],
        )
    assert path.exists()
    resumed = reconstruct(scan, projections, proj_geom, settings=settings, checkpoint=path, resume=True)
    assert np.array_equal(resumed.volume, whole.volume)


def test_a_calibration_does_not_see_the_order():
    scan = tps.simulate_scan("pins", size=16, views=30, scatter=0.05, metal=False)
    _, projections, proj_geom = mixed(scan)
    geometries = (astra.geom_2vec(scan.proj_geom), proj_geom)
    one, other = (
        reconstruct(scan, p, g, calibrate="scatter")
        for p, g in zip((scan.projections, projections), geometries)
    )
    assert one.plan["calibration"] == other.plan["calibration"]
    assert np.array_equal(one.volume, other.volume)
