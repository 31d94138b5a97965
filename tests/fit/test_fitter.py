"""A run's steps: how fast they go when time is short, and what growing and branching hold and leave behind."""

import math
import sys
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch

from tomo_polysplat.fit import fitter as fitters
from tomo_polysplat.fit.fitter import Batches, Fitter
from tomo_polysplat.fit.stopping import Clock

sys.path.append(str(Path(__file__).parents[1] / "kernels"))
from step_scenes import fit_problem


class ShortClock(Clock):
    """Of a run that has time for half of its steps, however long each takes."""

    def expected_steps(self, seconds):
        assert 0 < seconds < 1
        return self.steps // 2


def fitter_of(steps):
    return Fitter(fit_problem("cone", True, "cpu", "numba"), Batches(1, steps, np.random.default_rng(1)))


def rates(fitter):
    return fitter.step.rates


def after_a_pass(steps, clock):
    fitter = fitter_of(steps)
    fitter.ahead(clock(steps, None), 1)
    return fitter


def test_a_run_whose_time_is_short_learns_as_one_of_so_many_steps():
    planned, short, hurried = (
        rates(after_a_pass(*of)) for of in ((400, Clock), (200, Clock), (400, ShortClock))
    )
    assert hurried == short
    assert hurried["position"] == pytest.approx(math.sqrt(2) * planned["position"])
    assert hurried["attenuation"] == planned["attenuation"]


def test_its_pace_goes_with_a_branch_and_a_snapshot():
    hurried = after_a_pass(400, ShortClock)
    resumed = fitter_of(400)
    assert rates(resumed) != rates(hurried)
    resumed.restore(hurried.snapshot(None, {}))
    assert rates(resumed) == rates(hurried.branch(pixel_rays=1)) == rates(hurried)


def test_what_is_not_finite_any_more_is_told_and_not_looked_at(monkeypatch):
    fitter = fitter_of(400)
    read = fitter.step.read

    def diverged():
        told = read()
        with torch.no_grad():
            fitter.gaussians.position[fitter.gaussians.group.argmax()] = math.nan
        return told

    monkeypatch.setattr(fitter.step, "read", diverged)
    assert len(fitter.ahead(Clock(400, None), 2)) == 2 and fitter.relocated == 0


def test_a_cloud_grows_after_its_old_step_has_gone(monkeypatch):
    """Which on a GPU holds as much as the new one."""
    fitter = after_a_pass(400, Clock)
    fitter.most, before, done = 2 * len(fitter.gaussians), len(fitter.gaussians), fitter.step.done
    old, kept, make = weakref.ref(fitter.step), fitter.step.moments["blur"][0].clone(), fitters.make_step

    def made(*parts, **options):
        assert old() is None
        return make(*parts, **options)

    monkeypatch.setattr(fitters, "make_step", made)
    fitter._grow()
    assert len(fitter.gaussians) > before and fitter.step.done == done > 0
    assert torch.equal(fitter.step.moments["blur"][0], kept)
    assert fitter.step.moments["position"][0].any()


def test_a_branch_without_room_leaves_no_trace(monkeypatch):
    def full(setup, **_):
        # As the trial of a step would.
        setup.gaussians.position.fill_(torch.nan)
        raise torch.cuda.OutOfMemoryError("full")

    ends = []
    for asked in (False, True):
        fitter, clock = fitter_of(40), Clock(40, None)
        fitter.ahead(clock, 1)
        if asked:
            with monkeypatch.context() as patch, pytest.raises(torch.cuda.OutOfMemoryError):
                patch.setattr(fitters, "make_step", full)
                fitter.branch(pixel_rays=2)
        fitter.ahead(clock, 2)
        ends.append(fitter.snapshot(None, {}))
    one, other = ends
    assert one.numbers == other.numbers and np.array_equal(one.order, other.order)
    for name, tensor in one.gaussians.parameters().items():
        assert torch.equal(tensor, other.gaussians.parameters()[name]), name
        assert torch.equal(one.first[name], other.first[name]), name
