"""Gains and drift are taken out before the questions of a run; a steady scan is asked as if nobody had looked."""

from functools import cache

import numpy as np
import small_scans
import torch

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.plan import preparation
from tomo_polysplat.plan.early_light import take_out_early
from tomo_polysplat.plan.first_look import first_look
from tomo_polysplat.plan.fit_options import FitOptions
from tomo_polysplat.plan.light_told import EARLY_LIGHT, LightTold
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.scan.geometry import from_astra, projections_from_astra
from tomo_polysplat.settings import Settings

# Ten passes: one for the look is a tenth.
SETTINGS = {"passes": 10.0, "views_per_step": 12, "held_out": 0.06}


@cache
def scan():
    return small_scans.cone(size=18, views=37)


@cache
def light():
    """-log of gains (rows, columns) of 4 % and of the light of views, that drifts by 3 %."""
    rng = np.random.default_rng(5)
    rows, views, columns = scan().projections.shape
    drift = 0.03 * np.cumsum(rng.normal(0, 1, views)) / views**0.5
    return rng.normal(0, 0.04, (rows, columns)), drift - drift.mean()


@cache
def spoilt():
    gains, drift = light()
    return (scan().projections + gains[:, None] + drift[None, :, None]).astype(np.float32)


def looked_at(projections, **settings):
    """A problem, and the facts that a look at it gave."""
    chosen = Settings(**SETTINGS | settings)
    geometry, grid = from_astra(scan().proj_geom, scan().vol_geom)
    values = projections_from_astra(projections, scan().proj_geom).copy()
    problem = Problem.of(values, geometry, grid, scan().unit, scan().spectrum, None)
    look = first_look(
        preparation.lab_of(problem, Plan(), FitOptions(chosen, None, 0, torch.device("cpu"))), 1.0
    )
    return problem, take_out_early(look, chosen)


def test_most_of_them_is_taken_out_in_one_step_and_noise_is_told_anew():
    problem, facts = looked_at(spoilt())
    gains, drift = light()
    order = np.arange(len(drift)) if problem.order is None else problem.order
    assert np.std(problem.taken.gains - gains) < 0.75 * np.std(gains)
    assert np.std(problem.taken.drift - drift[order]) < 0.3 * np.std(drift)
    assert len(problem.taken.steps) == 1 and set(facts) == {"gains", "drift", EARLY_LIGHT}
    assert facts["gains"].value == facts[EARLY_LIGHT].value["gains"] > 0.02
    # As of rays that never had them, and not as those that were measured.
    whole = looked_at(scan().projections)[0].photons(torch.device("cpu"))
    assert abs(problem.photons(torch.device("cpu")) / whole - 1) < 0.2


def test_what_a_caller_wants_left_in_is_left_in():
    problem, facts = looked_at(spoilt(), gains=False)
    assert not problem.taken.gains.any() and problem.taken.drift.any() and "gains" not in facts
    problem, facts = looked_at(spoilt(), gains=False, drift=False)
    assert not problem.taken.steps and not facts


def test_what_changes_hardly_anything_is_left_to_the_run(monkeypatch):
    gains, drift = light()
    evidence = {"rms": 4e-5, "better": 4e-4, "error": 1e-4}
    told = {
        "drift": LightTold(True, drift, "", evidence | {"better": 0.05, "error": 0.01}),
        "gains": LightTold(True, 1e-3 * gains, "", evidence),
    }
    monkeypatch.setattr("tomo_polysplat.plan.early_light.ask_light", lambda *parts: dict(told))
    problem, facts = looked_at(scan().projections)
    assert problem.taken.drift.any() and not problem.taken.gains.any() and "gains" not in facts
    # Who asks for it has it at once.
    assert "gains" in looked_at(scan().projections, gains=True)[1]
    del told["drift"]
    problem, facts = looked_at(scan().projections)
    assert not problem.taken.steps and not facts


def test_of_a_steady_scanner_nothing_is_made_twice(monkeypatch):
    volumes, kept = [], preparation.first_volume
    monkeypatch.setattr(preparation, "first_volume", lambda *parts: volumes.append(parts) or kept(*parts))
    result = small_scans.reconstruct(scan(), settings=SETTINGS, progress=False, align="auto")
    assert len(volumes) == 1 and result.gains is None and EARLY_LIGHT not in result.plan
    monkeypatch.setattr(preparation, "first_volume", kept)
    # Without a look, the volume is the same to the bit.
    monkeypatch.setattr("tomo_polysplat.plan.scanner_as_it_was.first_look", lambda *_: None)
    alone = small_scans.reconstruct(scan(), settings=SETTINGS, progress=False, align=False)
    assert np.array_equal(alone.volume, result.volume)


def test_a_run_that_goes_on_has_them_taken_out_once(tmp_path):
    def run(**options):
        return small_scans.reconstruct(scan(), spoilt(), settings=SETTINGS, progress=False, **options)

    whole, path = run(), tmp_path / "run.npz"
    assert EARLY_LIGHT in whole.plan
    # Before the run has asked for itself, and after.
    for share in (0.05, 0.5):
        run(checkpoint=path, callbacks=[lambda state, share=share: state.share > share])
        on = run(checkpoint=path, resume=True)
        assert np.array_equal(on.volume, whole.volume) and np.array_equal(on.gains, whole.gains)
        path.unlink()
