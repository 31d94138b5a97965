"""Whether pixels average their light: scans of one ray a pixel and of several, and when nobody needs to ask."""

from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from killed_runs import assert_same, resumed_after
from planned import planned, told_beforehand

import tomo_polysplat as tps
from tomo_polysplat.fit.optimise import Run
from tomo_polysplat.fit.stopping import Clock
from tomo_polysplat.kernels.compile_time import working_time
from tomo_polysplat.plan.answer import Status
from tomo_polysplat.plan.decisions import pixel_rays
from tomo_polysplat.plan.decisions.pixel_rays import PixelRays
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.order import ask_between
from tomo_polysplat.settings import Settings

QUICK = {
    "passes": 10.0,
    "views_per_step": 4,
    "edges": "blurred",
    "tv_factor": 1.0,
    "gains": False,
    "drift": False,
}


@cache
def pins(subrays=1, metal=True, size=64, views=60, seed=0):
    options = {"geometry": "fan", "subrays": subrays, "metal": metal, "seed": seed}
    return tps.simulate_scan("pins", size=size, views=views, **options)


def thin():
    """A scan of infinitely thin rays."""
    return pins(size=44, views=52)


def small():
    """A scan of averaged light, for runs of which only the course matters."""
    return pins(3, size=40, views=42)


def large():
    """One whose volume tells averaged light from infinitely thin rays."""
    return pins(3, seed=2)


# Of these runs only the course matters: two fifths of the steps.
ROUGH = {"views_per_step": 10}


def reconstruct(scan, settings=None, **options):
    # Where the scanner stood, and what it did to the light, is asked in other files.
    usual = {"unit": scan.unit, "spectrum": scan.spectrum, "progress": False, "align": False}
    options = usual | {"calibrate": False} | options
    settings = QUICK | (settings or {})
    return tps.reconstruct(scan.projections, scan.proj_geom, scan.vol_geom, settings=settings, **options)


@cache
def told_of(scan):
    """A run that asks, which several tests compare with."""
    told = reconstruct(scan(), ROUGH if scan is small else None)
    assert "averaged light leaves" in told.plan["pixel_rays"].why
    return told


def error(result, scan):
    return float(np.sqrt(np.mean((result.volume - scan.truth) ** 2)))


@pytest.mark.parametrize(("scan", "taken", "other"), [(thin, 1, 2), (large, 2, 1)])
def test_the_rays_at_metal_tell_it(scan, taken, other):
    told, wrong = told_of(scan), reconstruct(scan(), {"pixel_rays": other})
    assert told.plan["pixel_rays"].value == taken and wrong.plan["pixel_rays"].status is Status.GIVEN
    assert error(told, scan()) < 0.7 * error(wrong, scan())


def test_the_loser_leaves_no_trace_of_itself():
    """Infinitely thin rays that were asked about are those that were asked for."""
    assert np.array_equal(told_of(thin).volume, reconstruct(thin(), {"pixel_rays": 1}).volume)


@pytest.mark.parametrize(
    ("metal", "changes", "one_energy", "words"),
    [
        (False, {}, False, "without metal"),
        (True, {"passes": 9.0}, False, "in so few passes"),
        (True, {}, True, "one energy"),
    ],
)
def test_nobody_asks_where_it_cannot_be_told(metal, changes, one_energy, words):
    scan = pins(metal=metal, size=40, views=42)
    scan = replace(scan, spectrum=None) if one_energy else scan
    told = told_beforehand(scan, "pixel_rays", **QUICK | changes)
    assert told.value == 1 and told.status is Status.USUAL and words in told.why
    # Else nothing would be told of it.
    assert told_beforehand(thin(), "pixel_rays", **QUICK) is None


def test_a_budget_with_time_to_spare_does_not_hinder_it():
    told, hurried = told_of(small), reconstruct(small(), ROUGH, time_budget=3600.0)
    assert told.plan["pixel_rays"] == hurried.plan["pixel_rays"]
    assert np.array_equal(told.volume, hurried.volume)


def amid(ahead, clock, steps=30):
    """The answer to the question of a run whose passes are ``ahead``, and the run."""
    other = SimpleNamespace(ahead=ahead)
    fitter = SimpleNamespace(ahead=ahead, branch=lambda pixel_rays: other, steps_of_a_pass=steps)
    run, lab = Run(fitter, clock), Lab(None, None, None, None, plan=planned(passes=15.0))
    clock.done = clock.steps // 2
    ask_between(lab, run, (PixelRays,))
    return lab.plan.answers["pixel_rays"], run, fitter


@pytest.mark.parametrize(("left", "kept"), [(14.0, True), (18.0, False)])
def test_a_short_budget_is_kept_for_the_fit(left, kept, monkeypatch):
    """Half of the run took four seconds, and averaged light takes four times as long."""
    monkeypatch.setattr(pixel_rays, "_share", lambda *both: 2.0)
    clock = Clock(10, working_time() + left)
    clock.begun = working_time() - 4.0
    answer, _, _ = amid(lambda clock, passes: [(0.2, 0.3, 1)] * passes, clock)
    assert answer.value == 1 and ("time budget" in answer.why) == kept


@pytest.mark.parametrize("passes", [0, 1])
def test_a_budget_that_ends_amid_the_question_leaves_the_run_as_it_was(passes):
    """However few passes it was able to make."""
    made = [(0.2, 0.3, 1)] * passes

    def slowly(clock, passes):
        clock.deadline = working_time() - 1
        return made

    answer, run, fitter = amid(slowly, Clock(10, working_time() + 3600))
    assert run.fitter is fitter and run.made == (made[0] if made else None)
    assert answer.value == 1 and "time budget" in answer.why


def passes_asked(monkeypatch, left, steps=30):
    """Passes that either way is asked for, one after the other, where averaged light leaves ``left`` after each."""
    asked, shares = [], iter(left)

    def ahead(clock, some):
        asked.append(some)
        return [(0.2, 0.3, 1)] * some

    monkeypatch.setattr(pixel_rays, "_share", lambda *both: next(shares))
    return amid(ahead, Clock(10, None), steps), asked


@pytest.mark.parametrize(("steps", "passes"), [(90, 2), (30, 2), (24, 3), (1, 3)])
def test_each_way_has_steps_enough_to_get_used_to_it_but_no_more_than_a_fifth_of_the_run(
    monkeypatch, steps, passes
):
    (answer, run, fitter), asked = passes_asked(monkeypatch, (1.6, 1.45, 1.1), steps)
    assert asked == 2 * passes * [1]
    assert run.made == (0.2, 0.3, passes)
    assert (answer.value, run.fitter is fitter) == ((2, False) if passes == 3 else (1, True))


@pytest.mark.parametrize(
    ("left", "passes"), [((1.6, 1.55), 2), ((1.2, 1.22), 2), ((1.6, 1.45, 1.45), 3), ((1.5, 1.42, 1.3), 3)]
)
def test_no_pass_is_made_that_would_have_to_change_more_than_the_last_one_did(monkeypatch, left, passes):
    (answer, _, _), asked = passes_asked(monkeypatch, left, steps=24)
    assert asked == 2 * passes * [1] and answer.value == (2 if left[-1] < 1.35 else 1)


@pytest.mark.parametrize(
    ("left", "steps", "averaged"), [(2.5, 30, False), (1.75, 100, False), (1.1, 30, True), (1.1, 100, True)]
)
def test_one_pass_each_way_is_enough_where_its_share_is_far_from_the_limit(
    monkeypatch, left, steps, averaged
):
    """The nearer the more steps it had."""
    (answer, run, fitter), asked = passes_asked(monkeypatch, (left,), steps)
    assert asked == [1, 1] and run.made == (0.2, 0.3, 1)
    assert answer.value == (2 if averaged else 1) and (run.fitter is fitter) is not averaged


def test_a_run_resumed_around_the_question_is_the_uninterrupted_one(tmp_path, monkeypatch):
    monkeypatch.setattr("tomo_polysplat.plan.checkpoint._LARGEST_SHARE", 1e9)
    scan, whole = small(), told_of(small)
    for share in (0.3, 0.4, 0.6):
        run = partial(reconstruct, scan, ROUGH)
        assert_same(resumed_after(share, run, tmp_path / f"{share}.npz"), whole, share)


def way(kind, **rays):
    """One way of a run, whose Gaussians are known by the rays that either kind of light makes of them."""
    scene = SimpleNamespace(projections=lambda gaussians, views: (gaussians[kind], 0))
    settings = Settings(loss="l1", model_error=0.1)
    return SimpleNamespace(scene=scene, gaussians=rays, rays=None, settings=settings)


@pytest.mark.parametrize(
    ("missed", "counts"),
    [
        (0.5, [0.0, 0.5**4, 1.0, 1.0]),
        (1.0, [0.0, 0.5**4, 1.0, 1.0]),
        (1.2, [0.0, 0.72**4, 1.0, 1.0]),
        (3.0, [0, 1, 1, 1]),
    ],
)
def test_rays_count_by_what_averaging_changes_in_them(monkeypatch, missed, counts):
    """Those that it leaves alone not at all; those far beyond their noise all alike, which is less far beyond the more
    the better fit, here the averaged one, misses such rays.
    """
    one = torch.ones(1, 1, 4)
    measured, changes = 2.0 * one, torch.tensor([0.0, 3.0, 6.0, 600.0])
    residuals = torch.tensor([9.0, 0.4, 0.5, 0.6])
    thin = way("thin", thin=measured + residuals)
    deviation = thin.settings.model_error
    averaged = measured + deviation * missed
    other = way("averaged", thin=averaged - deviation * changes, averaged=averaged)
    monkeypatch.setattr(pixel_rays, "batches_around", lambda rays: [(None, measured, one, None)])
    expected = deviation * missed * np.sum(counts) / (np.array(counts) @ residuals.numpy())
    assert pixel_rays._share(thin, other) == pytest.approx(expected, rel=1e-4)


def test_rays_that_averaging_leaves_alone_tell_nothing(monkeypatch):
    one = torch.ones(1, 1, 4)
    monkeypatch.setattr(pixel_rays, "batches_around", lambda rays: [(None, one, one, None)])
    assert pixel_rays._share(way("thin", thin=one), way("averaged", thin=one, averaged=one)) == np.inf
