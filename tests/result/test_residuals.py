"""Residuals in units of noise, from projections known in closed form, and the verdict that is drawn from them."""

from contextlib import nullcontext
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.plan.answer import Answer
from tomo_polysplat.render.renderer import detector_views
from tomo_polysplat.report.held_out import HeldOut
from tomo_polysplat.report.residuals import residuals_of
from tomo_polysplat.report.verdict import verdict
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.counts import Counts
from tomo_polysplat.scan.geometry import VolumeGrid, from_astra
from tomo_polysplat.scan.noise import RayNoise
from tomo_polysplat.scan.scan import Scan

WIDTH, HEIGHT, PHOTONS = 0.5, 0.2, 5e3
CENTRE = np.array([0.3, -0.2, 0.1])
VIEWS, ROWS, COLUMNS = 21, 25, 33
VOLUME = {
    "GridColCount": 9,
    "GridRowCount": 11,
    "GridSliceCount": 7,
    "option": {
        "WindowMinX": -2.0,
        "WindowMaxX": 2.0,
        "WindowMinY": -2.0,
        "WindowMaxY": 2.0,
        "WindowMinZ": -1.5,
        "WindowMaxZ": 1.5,
    },
}
CONE = {
    "type": "cone",
    "DetectorSpacingX": 0.3,
    "DetectorSpacingY": 0.3,
    "DetectorRowCount": ROWS,
    "DetectorColCount": COLUMNS,
    "ProjectionAngles": np.linspace(0, 2 * np.pi, VIEWS, endpoint=False),
    "DistanceOriginSource": 9.0,
    "DistanceOriginDetector": 6.0,
}


def line_integrals():
    """(views, rows, columns) of one round Gaussian: HEIGHT sqrt(2 pi) WIDTH exp(-d^2 / 2 WIDTH^2)."""
    geometry, _ = from_astra(CONE, VOLUME)
    images = []
    for view in range(VIEWS):
        origins, directions = geometry.rays(view)
        distance = np.linalg.norm(np.cross(CENTRE - origins, directions), axis=-1)
        images.append(HEIGHT * np.sqrt(2 * np.pi) * WIDTH * np.exp(-0.5 * (distance / WIDTH) ** 2))
    return np.array(images)


def scan_of(values, noise=True):
    rng = np.random.default_rng(3)
    if noise:
        values = -np.log(rng.poisson(PHOTONS * np.exp(-values)) / PHOTONS)
    return Scan(values.swapaxes(0, 1), CONE, VOLUME, name="ball")


def ball(plan=None):
    gaussians = {
        "position": CENTRE[None],
        "scale": np.full((1, 3), WIDTH),
        "rotation": np.array([[1.0, 0, 0, 0]]),
        "density": np.array([HEIGHT]),
        "u": np.zeros(1),
    }
    grid = VolumeGrid((7, 11, 9), (-2.0, -2.0, -1.5), (2.0, 2.0, 1.5))
    return Result(np.full((1, 7, 11, 9), 0.01), grid, gaussians=gaussians, plan=plan or {})


def ball_of(result):
    result.gaussians = ball().gaussians
    return result


def test_noise_that_is_as_strong_in_every_ray_is_its_own_unit(tmp_path, monkeypatch):
    noisy = line_integrals() + np.random.default_rng(3).normal(0, 0.02, (VIEWS, ROWS, COLUMNS))
    # So thin an object does not tell it from that of counts.
    told = RayNoise(deviation=0.02)
    monkeypatch.setattr("tomo_polysplat.report.residuals.ray_noise", lambda *_: told)
    result = ball()
    result.residuals = residuals_of(result, scan_of(noisy, noise=False))
    assert result.residuals.rms == pytest.approx(1, abs=0.02) and "noise" in result.residuals.unit
    result.save(tmp_path / "ball.h5")
    read = Result.load(tmp_path / "ball.h5").residuals
    assert (read.photons, read.deviation, read.noisy) == (np.inf, 0.02, True)


def test_the_right_model_leaves_noise():
    found = residuals_of(ball(), scan_of(line_integrals()))
    # Read off few rays, the photons are uncertain by some per cent.
    assert found.photons == pytest.approx(PHOTONS, rel=0.15)
    assert found.rms == pytest.approx(
        (found.photons / PHOTONS) ** 0.5, abs=0.02
    ) and found.within == pytest.approx(0.997, abs=0.003)
    assert found.rays == VIEWS * ROWS * COLUMNS
    assert np.abs(found.bias).mean() == pytest.approx(np.sqrt(2 / np.pi / VIEWS), rel=0.1), "normal means"
    assert verdict(ball(), found)[0].startswith("The model explains the rays to 1.1 times their noise: 99.")
    assert verdict(ball(), found)[2] == "Nothing stands out that ought to be distrusted."


def test_a_view_and_a_pixel_that_are_off_stand_out():
    values = line_integrals()
    values[6] += 0.06  # four deviations of noise
    values[:, 4, 20] += 0.1
    values[:, 17, 9] += 0.1
    found = residuals_of(ball(), scan_of(values))
    assert found.by_view.argmax() == 6 and found.by_view[6] > 3 * np.median(found.by_view)
    worst = np.argsort(np.abs(found.bias), axis=None)[-2:]
    assert {tuple(map(int, np.unravel_index(k, found.bias.shape))) for k in worst} == {(4, 20), (17, 9)}
    told = verdict(ball(), found)[2]
    assert "view 6, explained up to" in told and "whose pixels are off by the same amount" in told


def test_what_is_missing_is_placed():
    """Matter that the model lacks is where the rays meet that miss."""
    place = np.array([-0.9, 0.9, -0.4])
    geometry, _ = from_astra(CONE, VOLUME)
    values = line_integrals()
    for view in range(VIEWS):
        origins, directions = geometry.rays(view)
        distance = np.linalg.norm(np.cross(place - origins, directions), axis=-1)
        values[view] += 0.3 * np.exp(-0.5 * (distance / 0.15) ** 2)
    found = residuals_of(ball(), scan_of(values))
    np.testing.assert_allclose(found.worst, place, atol=0.3)
    assert found.worst_value > 3 * found.usual_value
    assert verdict(ball(), found)[2].startswith("Distrust what lies around x, y, z = ")


def test_scatter_of_the_plan_belongs_to_the_model():
    scan = scan_of(-np.log(np.exp(-line_integrals()) + 0.05))
    told = {"calibration": Answer.found({"fitted": {"scatter": 0.05}}), "fitted_blur": Answer.found(0.0)}
    assert residuals_of(ball(told), scan).rms == pytest.approx(1.0, abs=0.1)
    assert residuals_of(ball(), scan).rms > 3


def test_saturated_rays_are_no_measurement():
    """They hold 0 without noise: their residuals would say that the model is better than it is."""
    values = scan_of(line_integrals()).projections
    result = ball()
    result.gains = np.zeros((ROWS, COLUMNS))
    whole = residuals_of(result, scan_of(line_integrals()))
    found = residuals_of(result, Scan(np.maximum(values, 0.08), CONE, VOLUME, name="ball"))
    assert 0 < found.rays <= np.count_nonzero(values > 0.08) < 0.2 * whole.rays
    assert found.photons == pytest.approx(PHOTONS, rel=0.5) and found.rms == pytest.approx(1, abs=0.3)


def test_rays_that_are_not_valid_do_not_count():
    values = line_integrals()
    values[3] += 1.0
    scan = scan_of(values)
    scan.valid = np.ones(scan.projections.shape, bool)
    scan.valid[:, 3] = False
    found = residuals_of(ball(), scan)
    assert np.isnan(found.by_view[3]) and found.rms == pytest.approx(1.0, abs=0.1)


def test_another_scan_is_refused():
    other = Result(np.zeros((1, 3, 4, 5)), VolumeGrid((3, 4, 5), (-1, -1, -1), (1, 1, 1)))
    with pytest.raises(ValueError, match="with its Gaussians"):
        residuals_of(other, scan_of(line_integrals()))
    with pytest.raises(ValueError, match="scan: expected the scan of the result"):
        residuals_of(ball_of(other), scan_of(line_integrals()))


def test_without_any_gaussian_all_is_residual():
    values = np.full((VIEWS, ROWS, COLUMNS), 0.5)
    nothing = ball()
    nothing.gaussians = {name: part[:0] for name, part in nothing.gaussians.items()}
    found = residuals_of(nothing, scan_of(values))
    assert found.rms == pytest.approx(0.5 * found.photons**0.5, rel=0.01)


def test_the_page_of_a_scan_has_fdk_and_the_residuals(tmp_path):
    ball().report(tmp_path / "page.html", scan=scan_of(line_integrals()))
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert page.count("<figure>") == 2 and "FDK (the standard)" in page
    assert "rms residual by view" in page and "<h1>ball</h1>" in page
    assert page.index("The model explains") < page.index("<figure>"), "the verdict comes first"


def test_a_page_does_without_a_scan_that_does_not_fit(tmp_path, caplog):
    result = ball()
    other = Scan(line_integrals().swapaxes(0, 1), CONE, VOLUME | {"GridColCount": 8})
    result.report(tmp_path / "page.html", scan=other, overwrite=True)
    assert "does without what the scan would tell" in caplog.text
    assert "How well the rays are explained was not recorded" in (tmp_path / "page.html").read_text()


def test_the_rays_held_out_are_those_of_the_fit():
    """Its views are sorted, the scan's are not."""
    shuffled = np.random.default_rng(5).permutation(VIEWS)
    turned = CONE | {"ProjectionAngles": CONE["ProjectionAngles"][shuffled] - 1e-12}
    geometry, grid = from_astra(turned, VOLUME)
    values = line_integrals()[shuffled].astype(np.float32)
    problem = Problem.of(values.copy(), geometry, grid, "cm", None, None)
    measured, views = problem.measured(torch.device("cpu")), detector_views(problem.geometry, problem.planar)
    rays = Rays(measured, views, np.inf, 0.015, 0.1)
    aside = (rays.batch(np.arange(VIEWS))[3] > 0).numpy()
    found = HeldOut(geometry, grid, values, 0.1, torch.device("cpu")).of(np.arange(VIEWS)).numpy()
    assert found.mean() == pytest.approx(0.1, abs=0.01)
    # Each view of the fit has the rays of one view of the scan, whichever that is.
    fitted = rays.projections.numpy()
    for view in range(VIEWS):
        (same,) = [k for k in range(VIEWS) if np.array_equal(fitted[k], values[view])]
        np.testing.assert_array_equal(found[view], aside[same])


def test_a_view_tells_of_its_rays_held_out():
    """Those alone are off, as after a fit that has taken in their neighbours' noise."""
    values = line_integrals()
    geometry, grid = from_astra(CONE, VOLUME)
    aside = HeldOut(geometry, grid, values, 0.05, torch.device("cpu")).of(np.arange(VIEWS)).numpy()
    values[aside] += 0.1
    result = ball()
    result.settings = {"held_out": 0.05}
    found = residuals_of(result, scan_of(values))
    assert found.rms_held_out > 4 * found.rms / 2 and (found.held_out > 3).all()
    assert "(those kept out of the fit to" in verdict(result, found)[0]
    assert np.isnan(residuals_of(ball(), scan_of(values)).rms_held_out), "no settings, none held out"


def test_only_the_views_that_are_shown_are_read_and_those_that_values_tell_apart():
    """Two views are from 0 and 360 degrees, which the values put in order, in the fit as here."""
    values, read = line_integrals(), set()
    values[-1] = values[0]
    values[0] += 1e-3
    values = np.roll(values, 4, axis=0)
    told = CONE | {"ProjectionAngles": np.roll(np.append(CONE["ProjectionAngles"][:-1], 2 * np.pi), 4)}
    geometry, grid = from_astra(told, VOLUME)
    assert HeldOut.views_told_by_values(geometry, grid).tolist() == [3, 4]
    aside = HeldOut(geometry, grid, values, 0.05, torch.device("cpu")).of(np.arange(VIEWS)).numpy()
    values[aside] += 0.1
    stored = (1e7 * np.exp(-values)).astype(np.float64)

    def views_of(part):
        read.update(range(VIEWS)[part])
        return stored[part]

    images = np.full((ROWS, COLUMNS), 1e7), np.zeros((ROWS, COLUMNS))
    counts = Counts(lambda: nullcontext(views_of), stored.shape, "counts", *images)
    result = ball()
    result.settings = {"held_out": 0.05}
    found = residuals_of(result, Scan(counts, told, VOLUME, valid=counts.marks), most_views=3)
    assert found.views.tolist() == [0, 10, 20] and read == {0, 3, 4, 10, 20}
    assert (found.held_out > 4 * found.by_view / 2).all()


def scanned():
    result, scan = ball(), scan_of(line_integrals())
    result.settings = {"held_out": 0.01}
    return result, scan, result.explain(scan)


@pytest.mark.parametrize("endless", [False, True])
def test_residuals_are_saved_with_the_result(tmp_path, endless):
    """The unknown (no ray held out) and the endless (photons of data without noise) come back as they were."""
    result, _, found = scanned()
    assert np.isfinite(found.rms_held_out) and np.isfinite(found.photons)
    if endless:
        found = result.residuals = replace(found, rms_held_out=np.nan, photons=np.inf)
    result.save(tmp_path / "r.h5")
    loaded = Result.load(tmp_path / "r.h5").residuals
    for name, value in vars(found).items():
        np.testing.assert_allclose(getattr(loaded, name), value, rtol=1e-6, err_msg=name)
        assert np.asarray(getattr(loaded, name)).dtype.kind == np.asarray(value).dtype.kind, name
    ball().save(tmp_path / "without.h5")
    assert Result.load(tmp_path / "without.h5").residuals is None


def test_a_report_of_a_saved_result_shows_them_without_the_scan(tmp_path):
    result, _, found = scanned()
    result.save(tmp_path / "r.h5")
    Result.load(tmp_path / "r.h5").report(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert f"{found.rays} rays of {VIEWS} views" in page and verdict(result, found)[0] in page
    ball().report(tmp_path / "bare.html")
    assert "rms residual by view" not in (tmp_path / "bare.html").read_text()


@pytest.mark.parametrize(
    "name, value",
    [
        ("by_view", np.zeros(3)),
        ("bias", np.zeros((2, 2))),
        ("by_pixel", np.full((ROWS, COLUMNS), np.inf)),
        ("worst", np.zeros(2)),
        ("views", np.zeros((3, 7))),
        ("block", 0.0),
        ("rms", 1e300),
        ("photons", -1.0),
    ],
)
def test_damaged_residuals_are_refused(tmp_path, name, value):
    result, _, _ = scanned()
    result.save(tmp_path / "r.h5")
    with h5py.File(tmp_path / "r.h5", "r+") as file:
        kept = file["polysplat/residuals"]
        if name in kept:
            del kept[name]
            kept[name] = value
        else:
            kept.attrs[name] = value
    with pytest.raises(ValueError, match="/polysplat/residuals/"):
        Result.load(tmp_path / "r.h5")
