"""What a run is expected to take, by a clock that steps alone drive."""

import logging

import pytest
from small_scans import cone

import tomo_polysplat as tps
from tomo_polysplat import reconstruction
from tomo_polysplat.cli.main import main
from tomo_polysplat.fit import stopping
from tomo_polysplat.fit.step import EagerStep
from tomo_polysplat.fit.stopping import Clock
from tomo_polysplat.plan import preparation, solver
from tomo_polysplat.plan.expected import expected, only_told, tell
from tomo_polysplat.scan.io import save_scan


@pytest.fixture
def seconds(monkeypatch):
    """The seconds of a clock, in a list of one, for the test to add to."""
    now = [100.0]
    for module in (stopping, solver, reconstruction):
        monkeypatch.setattr(module, "working_time", lambda: now[0])
    return now


def run(clock, now, costs):
    """Steps that take these seconds, each settled at once."""
    for cost in costs:
        now[0] += cost
        clock.done += 1
        clock.look_ahead(lambda: None)


def test_a_step_is_timed_once_and_without_what_the_first_waits_for(seconds):
    told = []
    clock = Clock(1000, None, timed=lambda clock, a_step: told.append((clock.done, a_step)))
    # Every other step smooths, and takes thrice as long.
    run(clock, seconds, [60.0] + [0.02, 0.06] * 200)
    ((done, a_step),) = told
    assert a_step == pytest.approx(0.04) and done == 29


def test_a_short_run_is_timed_by_a_tenth_of_it(seconds):
    told = []
    run(Clock(40, None, timed=lambda clock, a_step: told.append(clock.done)), seconds, [0.001] * 40)
    assert told == [5]


def test_more_of_anything_takes_longer():
    base = {"steps": 100, "done": 4, "a_step": 0.1, "so_far": 3.0, "growth": 1.0, "memory": ""}
    least = expected(**base).seconds
    assert 12.6 < least < 16
    for more in ({"steps": 200}, {"a_step": 0.2}, {"so_far": 6.0}, {"growth": 4.0}, {"light_open": True}):
        assert expected(**(base | more)).seconds > least + 2.9


def test_long_runs_are_told_and_short_or_limited_ones_are_not(caplog):
    caplog.set_level(logging.INFO)
    tell(expected(100, 4, 0.01, 3.0, 1.0, ""), None)
    tell(expected(100, 4, 10.0, 3.0, 1.0, ""), 20.0)
    assert not caplog.records
    tell(expected(1000, 4, 1.0, 3.0, 1.0, "memory 3 GB of 7"), None)
    assert "about 17 min in all" in caplog.text and "memory 3 GB of 7" in caplog.text


@pytest.mark.parametrize("metal", [False, True])
def test_a_run_takes_what_was_expected(seconds, monkeypatch, metal):
    """Within a factor of 1.5, in steps of a second: those of short fits, of a start, and of second runs count too."""
    step = EagerStep.__call__

    def slow(self, views, share):
        seconds[0] += len(views) * self.scene.pixel_rays**2
        return step(self, views, share)

    monkeypatch.setattr(EagerStep, "__call__", slow)
    scan, settings = cone(10, 20, metal=metal), {"passes": 9}
    with only_told() as found:
        tps.reconstruct(scan, settings=settings, device="cpu", progress=False)
    early = seconds[0]
    result = tps.reconstruct(scan, settings=settings, device="cpu", progress=False)
    taken = seconds[0] - early
    assert len(found) == 1 and early - 100 < 0.7 * taken, "it ended when it was told"
    assert taken / 1.5 < found[0].seconds < 1.5 * taken
    assert "memory about" in found[0].describe() and len(result.history) > 1


def test_compiling_stands_apart(monkeypatch):
    """It comes once a machine, and is listened to in every run, with a time budget or without."""
    listened, counted = [], solver.compiled_seconds
    monkeypatch.setattr(preparation, "track_compiling", lambda: listened.append(True))
    monkeypatch.setattr(solver, "compiled_seconds", lambda: counted() + 3600)
    with only_told() as found:
        tps.reconstruct(cone(12, 24), settings={"passes": 9}, device="cpu", progress=False)
    assert listened and found[0].seconds < 3600 <= found[0].compiled
    assert "; compiling took 60 min besides, which comes once a machine" in found[0].describe()
    assert "compiling" not in expected(100, 4, 0.1, 3.0, 1.0, "", compiled=0.5).describe()


def test_a_run_that_tells_does_not_hide_what_goes_wrong():
    with pytest.raises(ValueError, match="nothing"), only_told():
        raise ValueError("nothing")


def test_check_says_it(tmp_path, capsys):
    save_scan(cone(12, 24), tmp_path / "scan.h5")
    main(["check", str(tmp_path / "scan.h5"), "--time", "--device", "cpu"])
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("recon  about") and "MB" in last and "steps of" in last
