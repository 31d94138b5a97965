"""Whether pixels average their light: scans of one ray a pixel and of several, and when nobody needs to ask."""

from functools import cache, partial
from types import SimpleNamespace

import numpy as np
import pytest
from killed_runs import assert_same, resumed_after
from planned import planned

import tomo_polysplat as tps
from tomo_polysplat.fit.optimise import Run
from tomo_polysplat.fit.stopping import Clock
from tomo_polysplat.kernels.compile_time import working_time
from tomo_polysplat.plan.answer import Status
from tomo_polysplat.plan.decisions.pixel_rays import PixelRays
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.order import ask_between

QUICK = {"passes": 10.0, "views_per_step": 2, "edges": "blurred", "tv_factor": 1.0}


@cache
def pins(subrays=1, metal=True, size=64, views=60):
    return tps.simulate_scan("pins", size=size, views=views, geometry="fan", subrays=subrays, metal=metal)


def thin():
    """A scan of infinitely thin rays."""
    return pins(size=40, views=42)


def small():
    """A scan of averaged light, for runs of which only the course matters."""
    return pins(3, size=40, views=42)


def large():
    """One whose volume tells averaged light from infinitely thin rays."""
    return pins(3)


def reconstruct(scan, settings=None, **options):
    # Where the scanner stood is asked in other files.
    usual = {"unit": scan.unit, "spectrum": scan.spectrum, "progress": False, "align": False}
    options = usual | options
    settings = QUICK | (settings or {})
    return tps.reconstruct(scan.projections, scan.proj_geom, scan.vol_geom, settings=settings, **options)


@cache
def told_of(scan):
    """A run that asks, which several tests compare with."""
    told = reconstruct(scan())
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
    ("metal", "changes", "options", "words"),
    [
        (False, {}, {}, "without metal"),
        (True, {"passes": 9.0}, {}, "in so few passes"),
        (True, {}, {"time_budget": 0.5}, "time budget"),
        (True, {}, {"spectrum": None}, "one energy"),
    ],
)
def test_nobody_asks_where_it_cannot_be_told(metal, changes, options, words):
    changes = {"views_per_step": 60} | changes  # the volume is nothing to them
    told = reconstruct(pins(metal=metal), changes, **options).plan["pixel_rays"]
    assert told.value == 1 and told.status is Status.USUAL and words in told.why


def test_a_budget_with_time_to_spare_does_not_hinder_it():
    told, hurried = told_of(small), reconstruct(small(), time_budget=3600.0)
    assert told.plan["pixel_rays"] == hurried.plan["pixel_rays"]
    assert np.array_equal(told.volume, hurried.volume)


def amid(monkeypatch, ahead, misfits=(1.0, 1.0)):
    """The answer to the question of a run whose ways go ``ahead`` and leave these misfits, and the run."""
    ways = [SimpleNamespace(ahead=ahead, left=left, name=name) for left, name in zip(misfits, "12")]
    averaged = SimpleNamespace()

    def branch(rays, batch, pixel_rays):
        return ways[pixel_rays - 1] if rays else averaged

    near = SimpleNamespace(rays="near metal", misfit_at_metal=lambda way: way.left)
    monkeypatch.setattr("tomo_polysplat.plan.decisions.pixel_rays.close_up", lambda fitter, views: near)
    clock = Clock(10, working_time() + 3600)
    clock.done = 5
    run, lab = Run(SimpleNamespace(branch=branch), clock), Lab(None, None, None, None, plan=planned(passes=15.0))
    fitter = run.fitter
    ask_between(lab, run, (PixelRays,))
    assert run.made is None and clock.done == 5
    return lab.plan.answers["pixel_rays"], run.fitter, fitter, averaged


def test_a_budget_that_ends_amid_the_question_leaves_the_run_as_it_was(monkeypatch):
    def slowly(clock, passes):
        clock.deadline = working_time() - 1

    answer, after, fitter, _ = amid(monkeypatch, slowly)
    assert after is fitter and answer.value == 1 and "time budget" in answer.why


@pytest.mark.parametrize(("thin", "left", "taken"), [(1.0, 1.0, 2), (1.0, 1.5, 1), (1.0, 0.5, 1), (0.0, 1.0, 1)])
def test_the_run_goes_on_from_where_it_stood_as_the_rays_at_metal_say(monkeypatch, thin, left, taken):
    answer, after, fitter, averaged = amid(monkeypatch, lambda clock, passes: None, (thin, left))
    assert answer.value == taken and answer.status is Status.ASKED
    assert after is (averaged if taken == 2 else fitter)


def test_a_run_resumed_around_the_question_is_the_uninterrupted_one(tmp_path, monkeypatch):
    monkeypatch.setattr("tomo_polysplat.plan.checkpoint._LARGEST_SHARE", 1e9)
    scan, whole = small(), told_of(small)
    for share in (0.3, 0.4, 0.6):
        run = partial(reconstruct, scan)
        assert_same(resumed_after(share, run, tmp_path / f"{share}.npz"), whole, share)
