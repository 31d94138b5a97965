"""When a run stops, and what it returns."""

import math

import pytest
import torch

from tomo_polysplat.fit.stopping import Clock, FitState, StopReason, Watch, usual_patience
from tomo_polysplat.kernels.compile_time import working_time
from tomo_polysplat.model.gaussians import Gaussians


def cloud(mark):
    group = torch.zeros(1, dtype=torch.int64)
    return Gaussians(
        *(torch.zeros(1, n) for n in (3, 3, 4)),
        torch.full((1,), float(mark)),
        *torch.zeros(2, 1),
        group,
        torch.zeros(1),
    )


def judge(watch, errors):
    """The answer to each pass; pass k has Gaussians of attenuation k."""
    answers = []
    for k, error in enumerate(errors):
        loss, held_out = error if isinstance(error, tuple) else (1.0, error)
        state = FitState(0.0, k, 1, loss, held_out, 0.5, lambda: None)
        answers.append(watch.judge(state, cloud(k)))
    return answers


def best(watch):
    return float(watch.best.attenuation[0])


def test_the_state_with_the_lowest_held_out_error_is_kept():
    """In the mean of four passes, or of those there are: 4, 3, 2, 2, 2.25, 3."""
    watch = Watch(10)
    assert judge(watch, [4.0, 2.0, 0.0, 2.0, 5.0, 5.0]) == [None] * 6
    assert best(watch) == 3


def test_one_pass_that_fits_by_chance_is_not_kept():
    watch = Watch(10)
    judge(watch, [8.0, 7.0, 6.0, 5.0, 2.0, 4.0, 3.5, 3.0])
    assert best(watch) == 7


def test_what_is_kept_is_a_copy():
    watch, gaussians = Watch(4), cloud(1)
    watch.judge(FitState(0.0, 0, 1, 1.0, 1.0, 0.5, lambda: None), gaussians)
    gaussians.attenuation.fill_(7)
    assert best(watch) == 1


def test_a_run_ends_after_as_many_passes_without_improvement():
    watch = Watch(3)
    answers = judge(watch, [2.0, 1.0, 2.0, 2.0, 2.0])
    assert answers[:4] == [None] * 4 and answers[4].reason is StopReason.HELD_OUT
    assert best(watch) == 1


def test_a_hair_is_no_improvement_but_still_the_best():
    watch = Watch(3)
    answers = judge(watch, [1.0, 0.9999, 0.9998, 0.9997])
    assert answers[-1] and best(watch) == 3


def test_gaussians_that_are_no_numbers_are_never_kept_however_good_the_misfit():
    watch, bad = Watch(4), cloud(1)
    assert judge(watch, [1.0]) == [None]
    bad.rotation[0, 2] = math.nan
    state = FitState(0.0, 0, 1, 0.5, 0.5, 0.5, lambda: None)
    assert watch.judge(state, bad).reason is StopReason.NOT_FINITE and watch.best.finite()
    with pytest.raises(FloatingPointError):
        Watch(4).judge(state, bad)


@pytest.mark.parametrize(("passes", "patience"), [(1.0, 4), (10.0, 4), (12.4, 5), (20.0, 8)])
def test_longer_runs_have_more_patience(passes, patience):
    assert usual_patience(passes) == patience


def test_patience_starts_again_with_every_improvement():
    watch = Watch(2)
    assert not any(judge(watch, [1.0, 1.2, 0.6, 1.0, 0.4, 0.8, 0.6]))


def test_without_held_out_rays_the_loss_is_watched_and_nothing_ends_early():
    watch = Watch(1)
    assert judge(watch, [(loss, math.nan) for loss in (3.0, 1.0, 1.0, 1.0, 9.0)]) == [None] * 5
    assert best(watch) == 3


def test_a_pass_that_met_no_held_out_ray_says_nothing():
    """As the last one of a time budget may: the fitted rays' misfit is another quantity, and mostly the smaller."""
    watch = Watch(3)
    assert judge(watch, [(0.2, 0.3), (0.19, 0.28), (0.18, 0.285), (0.01, math.nan)]) == [None] * 4
    assert best(watch) == 2 and watch.waited == 0
    watch = Watch(3)
    judge(watch, [(0.1, math.nan), (0.1, 0.3), (0.1, 0.4)])
    assert best(watch) == 1


def test_a_history_tells_all_but_the_best_state():
    errors = [(0.5, math.nan), (0.4, 0.6), (0.3, 0.5), (0.2, math.nan), (0.2, 0.9), (0.1, 0.8)]
    whole, resumed = Watch(9), Watch(9)
    judge(whole, errors)
    records = [{"loss": loss, "held_out": None if math.isnan(aside) else aside} for loss, aside in errors]
    resumed.recall(records, whole.best)
    assert vars(resumed) == vars(whole)


def test_a_loss_that_is_no_number_ends_the_run_with_what_was_best():
    watch = Watch(4)
    assert judge(watch, [2.0, 1.0, (math.nan, math.nan)])[-1].reason is StopReason.NOT_FINITE
    assert best(watch) == 1


@pytest.mark.parametrize("loss", [math.nan, math.inf])
def test_a_run_that_never_was_finite_says_so(loss):
    with pytest.raises(FloatingPointError, match="first pass"):
        judge(Watch(4), [(loss, math.nan)])


def test_a_run_without_a_deadline_is_timed_by_its_steps():
    clock = Clock(8, None)
    assert clock.share() == 0 and not clock.late
    clock.done = 6
    assert clock.share() == 0.75
    clock.done = 8
    assert clock.share() == 1 and not clock.late


def test_a_deadline_can_only_shorten_a_run():
    now = working_time()
    assert Clock(8, now - 1).share() == 1 and Clock(8, now - 1).late
    clock = Clock(8, now + 3600)
    clock.begun = now - 400
    assert clock.share() == 0 and not clock.late, "a tenth of the time is less than a step"
    clock.done = 4
    assert clock.share() == 0.5
    clock.begun = now - 3 * 3600
    assert clock.share() == pytest.approx(0.75, abs=1e-3)


def test_slower_steps_fit_in_where_the_time_left_is_enough_for_them():
    """Four steps took four seconds; four more, four times slower, take sixteen."""
    now = working_time()
    for left, fits in ((17, True), (15, False)):
        clock = Clock(8, now + left)
        clock.begun, clock.done = now - 4, 4
        assert clock.allows(4.0) == fits
    assert Clock(8, None).allows(1e9)


def test_a_clock_expects_as_many_steps_as_there_is_time_for():
    """A run is never longer for having time."""
    for left, expected in ((4.5, 9), (-1.0, 4), (3600.0, 20)):
        clock = Clock(20, working_time() + left)
        clock.done = 4
        assert clock.expected_steps(1.0) == expected
    assert Clock(20, None).expected_steps(1.0) == 20
