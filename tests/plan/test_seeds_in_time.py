"""A time budget that has no room for the run gets fewer Gaussians, and one that has gets the same as none."""

import numpy as np
import pytest
from planned import lab_of, problem

from tomo_polysplat.fit.step import EagerStep
from tomo_polysplat.kernels import compile_time
from tomo_polysplat.kernels.compile_time import working_time
from tomo_polysplat.plan.seeds_in_time import seed_for_time

A_STEP = 1e-3


@pytest.fixture
def clock(monkeypatch):
    """A clock that only steps move, by a millisecond for each Gaussian."""
    now, made = [0.0], EagerStep.__call__

    def slow(self, views, share):
        made(self, views, share)
        now[0] += A_STEP * len(self.gaussians)

    monkeypatch.setattr(EagerStep, "__call__", slow)
    monkeypatch.setattr(compile_time, "_now", lambda: now[0])
    return now


def run_of(lab):
    """Seconds of the whole run with the plan's seeds, by that clock."""
    plan = lab.plan
    return A_STEP * len(lab.seeds()) * np.ceil(plan.passes * len(lab.rays.views) / plan.views_per_step)


def scan():
    return problem(30, views=40)


def test_what_is_lacking_is_taken_from_seeds_and_steps_alike(clock):
    lab = lab_of(scan())
    before, whole = len(lab.seeds()), run_of(lab)
    # What is timed counts, too.
    end = 0.25 * whole + 3 * A_STEP * before
    seed_for_time(lab, working_time() + end)
    few = len(lab.seeds())
    assert lab.plan.facts["seeds_in_time"].value == pytest.approx(0.5 * before, abs=2)
    assert 0.3 * before < few < 0.7 * before and lab.plan.spacing > 1.3
    assert clock[0] == pytest.approx(3 * A_STEP * before)


@pytest.mark.parametrize(
    ("room", "settings"), [(1.1, {}), (0.1, {"max_gaussians": 900}), (0.1, {"seed_spacing": 2.5})]
)
def test_with_room_or_where_the_number_is_given_the_plan_stays(clock, room, settings):
    lab = lab_of(scan(), **settings)
    before, answers = lab.seeds(), dict(lab.plan.answers)
    seed_for_time(lab, working_time() + room * run_of(lab) + 3 * A_STEP * len(before))
    assert lab.plan.answers == answers and "seeds_in_time" not in lab.plan.facts
    assert lab.seeds() is before


def test_no_time_at_all_times_nothing(clock):
    lab = lab_of(scan())
    seed_for_time(lab, working_time())
    assert clock[0] == 0.0 and "seeds_in_time" not in lab.plan.facts


def test_no_time_that_the_seeds_leave_times_nothing(clock, monkeypatch):
    lab = lab_of(scan())
    seeds = lab.seeds()

    def slowly():
        clock[0] += 1.0
        return seeds

    monkeypatch.setattr(lab, "seeds", slowly)
    for short in (0.0, 0.5):
        seed_for_time(lab, working_time() + 1.0 - short)
    assert clock[0] == 2.0 and "seeds_in_time" not in lab.plan.facts


def test_an_outline_is_left_however_short_the_time_is(clock):
    lab = lab_of(scan())
    seed_for_time(lab, working_time() + 3 * A_STEP * len(lab.seeds()) + 1e-6)
    assert lab.plan.facts["seeds_in_time"].value == 12**3
