"""In whatever order views come, the volume is the same."""

from functools import partial

import astra
import numpy as np
import pytest
from small_scans import QUICK, cone, fan, posed, reconstruct

import tomo_polysplat as tps


def mixed(scan, seed=3):
    """A random order of the views, the projections in it, and their geometry as vectors."""
    order = np.random.default_rng(seed).permutation(scan.views)
    proj_geom = astra.geom_2vec(scan.proj_geom)
    return order, scan.projections[:, order], proj_geom | {"Vectors": proj_geom["Vectors"][order]}


def same_problem(one, other):
    """Whether two calls pose the same problem, to the bit, of rays that are counted alike."""
    (one, counts), (other, others) = one, other
    assert one.order is None and other.order is not None
    scanners = [
        [vars(of.geometry)[name] for name in ("origin", "corner", "u", "v")] + [of.projections]
        for of in (one, other)
    ]
    return counts == others and all(map(partial(np.array_equal, equal_nan=True), *scanners))


@pytest.mark.parametrize("make", [fan, cone, lambda: cone(18, 20, True)], ids=["fan", "cone", "few, metal"])
def test_the_order_of_the_views_does_not_matter(make):
    scan = make()
    _, projections, proj_geom = mixed(scan)
    one = posed(scan, proj_geom=astra.geom_2vec(scan.proj_geom))
    assert same_problem(one, posed(scan, projections, proj_geom))


def test_valid_goes_with_its_views():
    scan = fan()
    order, projections, proj_geom = mixed(scan)
    valid = np.ones(scan.projections.shape, bool)
    valid[0, 4, 20:30] = valid[0, 11] = False
    one = posed(scan, proj_geom=astra.geom_2vec(scan.proj_geom), valid=valid)
    assert same_problem(one, posed(scan, projections, proj_geom, valid=valid[:, order]))
    assert not same_problem(one, posed(scan, projections, proj_geom, valid=valid))


def test_whole_runs_are_the_same_in_any_order():
    """Bit by bit, the start (over subsets of the views where they are few), calibration and the run's record too."""
    scan = tps.simulate_scan("pins", size=16, views=20, scatter=0.05)
    _, projections, proj_geom = mixed(scan)
    one, other = (
        reconstruct(scan, p, g, align="auto", calibrate="scatter")
        for p, g in ((scan.projections, astra.geom_2vec(scan.proj_geom)), (projections, proj_geom))
    )
    assert np.array_equal(one.volume, other.volume) and one.counts == other.counts
    assert one.plan == other.plan and one.plan["calibration"].value["trials"]
    assert [r["held_out"] for r in one.history] == [r["held_out"] for r in other.history]


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
