"""Gains of pixels and drift of the source: found between passes, taken out, told, and kept."""

from functools import cache

import numpy as np
import pytest
import small_scans

import tomo_polysplat as tps
from tomo_polysplat.plan import steady_light
from tomo_polysplat.plan.light_told import LightTold
from tomo_polysplat.report.residuals import residuals_of
from tomo_polysplat.settings import Settings

QUICK = {"passes": 4.0, "views_per_step": 8, "held_out": 0.06}


@cache
def scan():
    return small_scans.cone(size=18, views=37)


@cache
def light():
    """-log of gains (rows, columns) of 4 % and of the light of views, that drifts by 2 %."""
    rng = np.random.default_rng(5)
    rows, views, columns = scan().projections.shape
    drift = 0.02 * np.cumsum(rng.normal(0, 1, views)) / views**0.5
    return rng.normal(0, 0.04, (rows, columns)), drift - drift.mean()


@cache
def spoilt():
    gains, drift = light()
    return (scan().projections + gains[:, None] + drift[None, :, None]).astype(np.float32)


def reconstruct(projections, **options):
    settings = QUICK | options.pop("settings", {})
    return small_scans.reconstruct(scan(), projections, settings=settings, progress=False, **options)


@cache
def result(**switches):
    return reconstruct(spoilt(), settings=switches)


def left(result):
    gains, drift = light()
    return np.std(result.gains - gains), np.std(result.drift - drift)


def error(result):
    return float(np.sqrt(np.mean((result.volume - scan().truth) ** 2)))


def test_both_are_found_and_taken_out():
    of, off = result(), result(gains=False, drift=False)
    of_gains, of_drift = left(of)
    # A ring is explained by the object as well, which keeps up to half of their power.
    assert of_gains < 0.65 * 0.04 and of_drift < 0.15 * np.std(light()[1])
    assert off.gains is None and off.drift is None and off.plan["gains"].why == "asked for"
    assert error(of) < 0.995 * error(off)
    assert of.plan["gains"].value == pytest.approx(np.std(of.gains), rel=0.01)


def test_a_steady_scanner_is_left_as_it_is():
    plain = reconstruct(scan().projections)
    off = reconstruct(scan().projections, settings={"gains": False, "drift": False})
    assert plain.plan["gains"].value == 0.0 and plain.gains is None
    assert abs(error(plain) / error(off) - 1) < 0.005


def test_each_is_switched_by_itself():
    assert result(gains=False).gains is None and result(drift=False).drift is None
    # Unasked, a drift behind gains that stay is too little for held-out rays to tell.
    asked = result(gains=False, drift=True).drift
    np.testing.assert_allclose(asked, light()[1], atol=0.004)
    for wrong in ("on", 1.0):
        with pytest.raises(TypeError, match="gains"):
            Settings(gains=wrong)


def test_the_order_of_views_is_the_callers():
    order = np.random.default_rng(0).permutation(len(light()[1]))
    geometry = dict(scan().proj_geom)
    name = "Vectors" if "Vectors" in geometry else "ProjectionAngles"
    geometry[name] = np.asarray(geometry[name])[order]
    mixed = reconstruct(spoilt()[:, order], proj_geom=geometry)
    assert np.array_equal(mixed.volume, result().volume)
    assert np.array_equal(mixed.drift, result().drift[order])


def test_a_run_that_goes_on_is_the_run_without_interruption(tmp_path):
    path = tmp_path / "run.npz"
    reconstruct(spoilt(), checkpoint=path, callbacks=[lambda state: state.share > 0.6])
    on = reconstruct(spoilt(), checkpoint=path, resume=True)
    assert np.array_equal(on.volume, result().volume)
    assert np.array_equal(on.gains, result().gains) and np.array_equal(on.drift, result().drift)


class _Gains:
    """A problem, run and fit of which gains are found in the third look, or never."""

    def __init__(self, monkeypatch, ever):
        self.looks, self.taken, self.gains, self.steps = [], self, np.zeros(1), []
        self.plan = self.fitter = self.rays = self.clock = self
        self.facts, self.gaussians, self.scene, self.settings = {}, None, None, None
        monkeypatch.setattr(steady_light, "ask_light", lambda *parts: self.told("all", ever))
        monkeypatch.setattr(steady_light, "ask_gains_again", lambda *parts: self.told("again", ever))

    def told(self, kind, ever):
        self.looks.append((kind, self.now))
        kept = ever and len(self.looks) > 2
        evidence = {"rms": 0.01, "better": 0.1, "error": 0.0}
        return {"gains": LightTold(kept, np.full(1, 0.01 if kept else 0.0), "", evidence)}

    def add(self, gains):
        self.gains = self.gains + gains

    def share(self):
        return self.now

    def run(self):
        steady = steady_light.SteadyLight(self, self, Settings(drift=False))
        for self.now in np.arange(1, 21) / 20:
            steady.between(self)
        return self.looks


def test_once_gains_are_found_every_pass_is_asked_about_them(monkeypatch):
    looks = _Gains(monkeypatch, ever=True).run()
    whole = [share for kind, share in looks if kind == "all"]
    assert whole == pytest.approx(steady_light._SHARES)
    assert [share for kind, share in looks if share > 0.3] == pytest.approx(np.arange(7, 20) / 20)
    # A steady scanner is asked three times, and pays for no more.
    assert [kind for kind, _ in _Gains(monkeypatch, ever=False).run()] == ["all"] * 3


def test_a_run_of_many_passes_goes_on_as_well(tmp_path):
    path, many = tmp_path / "run.npz", {"passes": 14.0, "views_per_step": 12}
    reconstruct(spoilt(), settings=many, checkpoint=path, callbacks=[lambda state: state.share > 0.52])
    on = reconstruct(spoilt(), settings=many, checkpoint=path, resume=True)
    assert np.array_equal(on.volume, result(**many).volume) and np.array_equal(on.gains, result(**many).gains)


def test_files_and_report_know_them(tmp_path):
    of = result()
    of.save(tmp_path / "result.h5")
    again = tps.Result.load(tmp_path / "result.h5")
    assert np.array_equal(again.gains, of.gains) and np.array_equal(again.drift, of.drift)
    measured = tps.Scan(
        spoilt(), scan().proj_geom, scan().vol_geom, unit=scan().unit, spectrum=scan().spectrum
    )
    # Residuals are in units of a noise that gains would add to.
    known = residuals_of(again, measured, device="cpu")
    again.gains = again.drift = None
    ignored = residuals_of(again, measured, device="cpu")
    assert known.rms / known.photons**0.5 < 0.8 * ignored.rms / ignored.photons**0.5
