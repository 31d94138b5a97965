"""What is beyond doubt is mended, and nothing else."""

from dataclasses import replace

import astra
import numpy as np

import tomo_polysplat as tps
from tomo_polysplat.scan.check import DEFECT, check_scan
from tomo_polysplat.scan.mending import mend_scan
from tomo_polysplat.simulate.scenes import simulate_scan


def test_an_axis_that_is_off_is_put_right_once():
    scan = simulate_scan("teeth", 32, 61)
    off = replace(scan, proj_geom=astra.geom_postalignment(scan.proj_geom, (-2.25, 0.0)))
    before = off.proj_geom["Vectors"].copy()
    mended, done = mend_scan(off)
    assert len(done) == 1 and "2.2" in done[0] and (off.proj_geom["Vectors"] == before).all()
    assert DEFECT not in {finding.verdict for finding in check_scan(mended)}
    again, more = mend_scan(mended)
    assert again is mended and not more


def test_reconstruct_mends_and_says_so_unless_told_not_to():
    scan = simulate_scan("teeth", 24, 41)
    off = replace(scan, proj_geom=astra.geom_postalignment(scan.proj_geom, (-2.25, 0.0)))
    quick = {"settings": {"passes": 0.5, "views_per_step": 8}, "calibrate": False}
    mended, left, right = (
        tps.reconstruct(s, mend=m, **quick) for s, m in ((off, True), (off, False), (scan, True))
    )
    told = astra.geom_2vec(scan.proj_geom)["Vectors"]
    assert np.abs(mended.geometry["Vectors"] - told).max() < 0.3 * np.linalg.norm(told[0, 6:9])
    assert "2.2" in mended.plan["mended"].why
    np.testing.assert_allclose(left.geometry["Vectors"], off.proj_geom["Vectors"], atol=1e-9)
    assert "mended" not in left.plan and "mended" not in right.plan
    as_arrays = tps.reconstruct(
        scan.projections, scan.proj_geom, scan.vol_geom, spectrum=scan.spectrum, **quick
    )
    np.testing.assert_array_equal(right.volume, as_arrays.volume)


def test_what_is_not_told_by_the_rays_is_left():
    scan = simulate_scan("teeth", 20, 30, geometry="parallel", arc_degrees=90)
    assert mend_scan(scan) == (scan, [])
    assert np.isfinite(scan.projections).all()
