"""What no ray sees is told apart from air."""

import astra
import numpy as np
import pytest

import tomo_polysplat as tps
from tomo_polysplat.cli.main import main
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.coverage import unseen_share
from tomo_polysplat.scan.geometry import from_astra, to_astra
from tomo_polysplat.scan.io import save_scan


def small_view():
    """A parallel beam whose detector is half as wide as the volume, and a third as high, over two turns."""
    proj_geom = astra.create_proj_geom(
        "parallel3d", 0.1, 0.1, 7, 11, np.linspace(0, np.pi, 40, endpoint=False)
    )
    return proj_geom, astra.create_vol_geom(22, 22, 21, -1.1, 1.1, -1.1, 1.1, -1.05, 1.05)


def result_of(proj_geom, vol_geom):
    geometry, grid = from_astra(proj_geom, vol_geom)
    return Result(np.ones((1, *grid.shape)), grid, geometry=to_astra(geometry, grid)[0])


def test_voxels_are_seen_by_the_views_whose_detector_they_fall_on():
    result = result_of(*small_view())
    x, y, z = result.grid.axes()
    inside = np.hypot(x[None], y[:, None]) < 0.55 - 1e-6
    seen = result.coverage
    assert seen.shape == result.volume.shape and seen.min() == 0 and seen.max() == 1
    assert (seen[np.abs(z) > 0.36] == 0).all()
    middle = seen[np.abs(z) < 0.34]
    assert (middle[:, inside] == 1).all()
    # Of a point outside of the circle, the share of the turn in which it lies before the detector.
    radius = np.hypot(x[None], y[:, None])[~inside]
    np.testing.assert_allclose(middle[0][~inside], 2 / np.pi * np.arcsin(0.55 / radius), atol=0.06)
    geometry, grid = from_astra(*small_view())
    assert unseen_share(geometry, grid) == pytest.approx((seen == 0).mean(), abs=0.06)


def test_files_mark_what_is_not_seen(tmp_path):
    result = result_of(*small_view())
    result.save(tmp_path / "whole.npy")
    result.save(tmp_path / "marked.npy", unseen_nan=True)
    assert np.isfinite(np.load(tmp_path / "whole.npy")).all()
    np.testing.assert_array_equal(np.isnan(np.load(tmp_path / "marked.npy")), result.coverage == 0)
    for name, more in (("all.h5", {}), ("few.tif", {"bits": 16})):
        with pytest.raises(ValueError, match="unseen_nan"):
            result.save(tmp_path / name, unseen_nan=True, **more)
    result.geometry = None
    del result.coverage
    with pytest.raises(ValueError, match="geometry"):
        result.save(tmp_path / "none.npy", unseen_nan=True)


def test_a_reconstruction_tells_of_it(tmp_path):
    proj_geom, vol_geom = small_view()
    values = np.full((7, 40, 11), 0.2, np.float32) + np.random.default_rng(0).normal(0, 0.01, (7, 40, 11))
    scan = tps.Scan(values.astype(np.float32), proj_geom, vol_geom)
    result = tps.reconstruct(scan, settings={"passes": 0.1, "views_per_step": 8})
    assert result.plan["unseen"].value == pytest.approx((result.coverage == 0).mean(), abs=0.06)
    assert "not air" in result.plan["unseen"].why
    result.report(tmp_path / "page.html")
    assert "which no ray sees" in (tmp_path / "page.html").read_text()
    save_scan(scan, tmp_path / "scan.npz")
    asked = ["recon", str(tmp_path / "scan.npz"), "--unseen-nan", "--set", "passes=0.1", "--no-mend"]
    assert main([*asked, "-o", str(tmp_path / "a.h5")]) == 2
    assert main([*asked, "-o", str(tmp_path / "a.npy")]) == 0
    assert np.isnan(np.load(tmp_path / "a.npy")).mean() == pytest.approx((result.coverage == 0).mean())
