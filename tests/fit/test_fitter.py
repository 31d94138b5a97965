"""A run's steps: how fast they go when time is short."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest

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
    gaussians, spacing, rays, scene, settings = fit_problem("cone", True, "cpu", "numba")
    return Fitter(gaussians, spacing, rays, scene, settings, Batches(1, steps, np.random.default_rng(1)))


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
