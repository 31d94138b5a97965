"""A run's steps: how fast they go when time is short."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest

from tomo_polysplat.fit.fitter import Fitter
from tomo_polysplat.fit.stopping import Clock

sys.path.append(str(Path(__file__).parents[1] / "kernels"))
from step_scenes import fit_problem


class SlowClock(Clock):
    """Of a run that has time for half of its steps."""

    def expected_steps(self):
        return self.steps // 2


def rates_after_a_pass(steps, clock):
    gaussians, spacing, rays, scene, settings = fit_problem("cone", True, "cpu", "numba")
    fitter = Fitter(gaussians, spacing, rays, scene, settings, 1, steps, np.random.default_rng(1))
    fitter.ahead(clock(steps, None), 1)
    return {group["name"]: group["rate"] for group in fitter.step.optimiser.param_groups}


def test_a_run_whose_time_is_short_learns_as_one_of_so_many_steps():
    planned, short, hurried = (
        rates_after_a_pass(*of) for of in ((400, Clock), (200, Clock), (400, SlowClock))
    )
    assert hurried == short
    assert hurried["position"] == pytest.approx(math.sqrt(2) * planned["position"])
    assert hurried["attenuation"] == planned["attenuation"]
