"""Seeds, time, callbacks, interruption and threads."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from small_scans import ENDLESS, QUICK, fan, reconstruct, relative

from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.step import EagerStep
from tomo_polysplat.kernels.device import one_torch_thread
from tomo_polysplat.kernels.voxelise.box import VoxelBox


def test_the_same_seed_gives_the_same_bits_and_another_others():
    first, again, other = (reconstruct(fan(), seed=seed) for seed in (3, 3, 4))
    assert np.array_equal(first.volume, again.volume)
    assert all(np.array_equal(first.gaussians[k], again.gaussians[k]) for k in first.gaussians)
    assert not np.array_equal(first.volume, other.volume)
    assert relative(other.volume, first.volume) < 0.5, "other views first, not another object"


def test_a_time_budget_is_kept():
    reconstruct(fan())  # compiled and warm
    begun = time.perf_counter()
    result = reconstruct(fan(), settings=ENDLESS, time_budget=1.0)
    assert 0.9 < time.perf_counter() - begun < 2.5
    assert "time budget" in result.plan["stop"].why
    assert result.history and result.history[-1]["seconds"] < 1.5


def test_a_budget_too_small_for_anything_still_returns_the_start_and_says_so(caplog):
    with caplog.at_level("WARNING"):
        result = reconstruct(fan(), time_budget=1e-6)
    assert (
        result.volume.max() > 0.1 and "time budget was used before the first step" in result.plan["stop"].why
    )
    assert "no better than its start" in caplog.text


def test_callbacks_see_every_pass():
    states = []
    result = reconstruct(fan(), settings={"passes": 3.0}, callbacks=[lambda state: states.append(state)])
    assert len(states) == 3 == len(result.history)
    assert [state.iteration for state in states] == [record["iteration"] for record in result.history]
    assert [state.share for state in states] == pytest.approx([1 / 3, 2 / 3, 1])
    for state in states:
        assert state.gaussians == result.counts["gaussians"] and state.loss > 0 and state.held_out > 0


def test_the_volume_of_a_callback_is_the_volume_so_far():
    volumes = []
    result = reconstruct(fan(), callbacks=[lambda state: volumes.append(state.volume())])
    assert len(volumes) == 2 and not np.array_equal(*volumes)
    nearest = min(relative(volume, result.volume) for volume in volumes)
    assert nearest < 1e-5


@pytest.mark.parametrize("metal", [True, False])
def test_a_fit_that_stops_being_finite_returns_its_best_state(metal, monkeypatch):
    made = EagerStep.__call__

    def spoil(step, *what):
        made(step, *what)
        if step.done == 7:  # In the second pass.
            with torch.no_grad():
                step.gaussians.position[((step.gaussians.group > 0) == metal).nonzero()[0, 0]] = torch.nan

    monkeypatch.setattr(EagerStep, "__call__", spoil)
    result = reconstruct(fan(), settings=QUICK | {"passes": 5.0})
    assert result.plan["stop"].value == "not finite"
    assert len(result.history) == 2 and np.isfinite(result.volume).all() and result.volume.max() > 0.1


@pytest.mark.parametrize("answer", [True, np.True_])
def test_a_callback_can_end_the_fit(answer):
    result = reconstruct(
        fan(), settings=ENDLESS, callbacks=[lambda state: answer if state.iteration > 20 else False]
    )
    *before, last = [entry["iteration"] for entry in result.history]
    assert "callback" in result.plan["stop"].why
    assert before and max(before) <= 20 < last


def test_what_a_callback_returns_by_chance_does_not_end_the_fit():
    result = reconstruct(fan(), callbacks=[lambda state: "done", lambda state: 1, lambda state: [True]])
    assert "passes" in result.plan["stop"].why


def test_an_interruption_returns_the_best_so_far():
    def interrupt(state):
        if state.share > 0:
            raise KeyboardInterrupt

    threads = torch.get_num_threads()
    result = reconstruct(fan(), settings=ENDLESS, callbacks=[interrupt])
    assert result.plan["stop"].value == "interrupted" and len(result.history) == 1
    assert result.volume.max() > 0.1 and torch.get_num_threads() == threads


def test_progress_goes_from_nothing_to_all_with_words():
    told = []
    reconstruct(fan(), progress=lambda share, words: told.append((share, words)))
    shares = [share for share, _ in told]
    assert shares[0] == 0 and shares[-1] == 1 and shares == sorted(shares)
    assert all(words for _, words in told)


def test_a_bar_is_drawn_only_when_asked_for(capfd):
    reconstruct(fan(), progress=False)
    reconstruct(fan(), progress=None)  # no terminal here
    assert capfd.readouterr().err == ""
    # A pass takes longer than the tenth of a second that lies between two drawings at least.
    reconstruct(fan(), progress=True, settings={"passes": 2.0, "views_per_step": 1})
    assert "held-out error" in capfd.readouterr().err


class Broken(Exception):
    pass


@pytest.mark.parametrize("number", [1, 2, 3])
def test_the_number_of_threads_is_restored_even_after_a_failure(number):
    def fail(state):
        assert torch.get_num_threads() == 1
        raise Broken

    before = torch.get_num_threads()
    try:
        torch.set_num_threads(number)
        with pytest.raises(Broken):
            reconstruct(fan(), callbacks=[fail])
        assert torch.get_num_threads() == number
    finally:
        torch.set_num_threads(before)


def test_overlapping_runs_leave_the_number_of_threads_as_it_was():
    """The first to come is the first to go: the second must not restore what the first had set."""
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        cpu = torch.device("cpu")
        first, second = one_torch_thread(cpu), one_torch_thread(cpu)
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        second.__exit__(None, None, None)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_reconstructions_in_two_threads_equal_those_in_turn():
    scans = fan(), fan(False)
    expected = [reconstruct(scan).volume for scan in scans]
    found: dict[int, np.ndarray] = {}
    threads = [
        threading.Thread(target=lambda k=k: found.update({k: reconstruct(scans[k]).volume})) for k in (0, 1)
    ]
    before = torch.get_num_threads()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert torch.get_num_threads() == before
    assert all(np.array_equal(found[k], expected[k]) for k in (0, 1))


def test_every_kernel_of_the_cpu_gives_the_same_volume():
    scan = fan(False)
    vol_geom = scan.vol_geom | {"GridRowCount": 16, "GridColCount": 16}
    pair = [
        reconstruct(scan, vol_geom=vol_geom, settings=QUICK | {"kernel": kernel, "passes": 1.0}).volume
        for kernel in ("numba", "reference")
    ]
    # Rounding differs, and a fit amplifies it.
    assert relative(*pair) < 0.01


def test_a_volume_that_takes_the_budget_leaves_half_of_it_to_the_fit(monkeypatch):
    reconstruct(fan())  # compiled and warm
    monkeypatch.setattr(FitScene, "seconds_of_basis", lambda self, gaussians: 100.0)
    result = reconstruct(fan(), settings=ENDLESS, time_budget=2.0)
    assert result.history and 0.5 < result.history[-1]["seconds"] < 1.9


@pytest.mark.parametrize("compiling", [0.0, 40.0])
def test_what_a_volume_takes_is_told_by_some_of_its_slices(compiling):
    """With a clock that a volume moves by five seconds and each of its slices by one more."""
    box, now, first = VoxelBox(np.zeros(3), np.ones(3), (17, 4, 5)), [0.0], [compiling]
    scene = FitScene(box, None, 1.0, None, None, 0.0, "reference", 0.1, False, (0.1, 0.1), False, 1, 0.2)

    def basis(self, gaussians):
        now[0] += 5 + self.box.shape[0] + (first.pop() if first else 0.0)
        return torch.zeros(1, *self.box.shape)

    on_the_host = SimpleNamespace(position=torch.zeros(0, 3))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FitScene, "basis", basis)
        patch.setattr("tomo_polysplat.fit.scene.time", SimpleNamespace(perf_counter=lambda: now[0]))
        assert scene.seconds_of_basis(on_the_host) == pytest.approx(2 * (5 + 17))
