"""Ctrl-C at every stage, in the library, in TomoPy and on the command line, loses nothing."""

import os
import signal
import threading
import time

import numpy as np
import pytest
from small_scans import ENDLESS, fan, reconstruct

import tomo_polysplat as tps
from tomo_polysplat.cli.main import main
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.interrupts import postponed_interrupts


def ctrl_c():
    """What a terminal does."""
    signal.raise_signal(signal.SIGINT)


def interrupting(function, times=1):
    """The function, with so many Ctrl-C in the middle of its first call."""
    left = [times]

    def wrapped(*args, **options):
        while left[0]:
            left[0] -= 1
            ctrl_c()
        return function(*args, **options)

    return wrapped


def test_in_the_start_stage_it_says_that_there_is_no_result(monkeypatch, tmp_path):
    path = tmp_path / "fit.npz"
    start = interrupting(lambda *_: None)
    monkeypatch.setattr("tomo_polysplat.plan.preparation.first_volume", start)
    with pytest.raises(KeyboardInterrupt, match="no result yet"):
        reconstruct(fan(), checkpoint=path)
    assert os.listdir(tmp_path) == [] and signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("delay", [0.02, 0.3])
def test_at_any_moment_of_the_fit_it_returns_what_there_is(delay):
    reconstruct(fan())  # compiled and warm
    began = threading.Event()

    def press():
        began.wait()
        time.sleep(delay)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=press)
    thread.start()
    result = reconstruct(
        fan(), settings=ENDLESS, progress=lambda share, words: began.set() if share > 0 else None
    )
    thread.join()
    assert result.plan["stop"].value == "interrupted" and result.history
    assert np.isfinite(result.volume).all() and result.volume.max() > 0.1


def test_in_the_first_pass_it_returns_a_physical_volume(monkeypatch):
    monkeypatch.setattr(FitScene, "projections", interrupting(FitScene.projections))
    result = reconstruct(fan())
    assert result.plan["stop"].value == "interrupted" and not result.history
    assert result.volume.max() > 0.1 and result.volume.min() >= 0


def test_during_the_volume_the_volume_is_finished(monkeypatch, caplog):
    whole = reconstruct(fan())
    monkeypatch.setattr(FitScene, "basis", interrupting(FitScene.basis))
    result = reconstruct(fan())
    assert np.array_equal(result.volume, whole.volume)
    assert result.plan["stop"].why == whole.plan["stop"].why + ", then interrupted"
    assert "the volume is finished first" in caplog.text
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_second_one_during_the_volume_gives_up(monkeypatch):
    monkeypatch.setattr(FitScene, "basis", interrupting(FitScene.basis, times=2))
    with pytest.raises(KeyboardInterrupt):
        reconstruct(fan())
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_handler_of_the_callers_own_stays():
    heard = []
    before = signal.signal(signal.SIGINT, lambda *_: heard.append(True))
    try:
        with postponed_interrupts("this") as interruption:
            ctrl_c()
        assert heard == [True] and not interruption.asked
    finally:
        signal.signal(signal.SIGINT, before)


def test_an_error_in_a_postponed_block_gives_the_handler_back():
    with pytest.raises(ZeroDivisionError), postponed_interrupts("this"):
        ctrl_c()
        _ = 1 / 0
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_tomopy_on_one_core_gets_the_best_slices():
    tomo = np.repeat(fan(False).projections, 2, axis=0)
    recon = np.zeros((2, 72, 72), np.float32)
    theta = np.linspace(0, np.pi, 40, endpoint=False, dtype=np.float32)
    results = []
    options = {
        "settings": ENDLESS,
        "callbacks": [lambda state: ctrl_c()],
        "on_result": results.append,
    }
    centre = np.full(2, 36, np.float32)
    tps.polysplat(tomo, centre, recon, theta, num_gridx=72, num_gridy=72, options=options)
    assert results[0].plan["stop"].value == "interrupted" and recon.max() > 0


def test_tomopy_refuses_one_checkpoint_for_two_solves(tmp_path):
    tomo, recon = np.ones((2, 5, 8), np.float32), np.zeros((2, 8, 8), np.float32)
    options = {"checkpoint": tmp_path / "fit.npz"}
    with pytest.raises(ValueError, match="one centre for all slices"):
        tps.polysplat(
            tomo, np.array([4, 4.5], np.float32), recon, np.arange(5, dtype=np.float32), options=options
        )


# The command line


def test_the_command_saves_the_best_state_and_says_130(scan_file, tmp_path, monkeypatch):
    monkeypatch.setattr(FitScene, "projections", interrupting(FitScene.projections))
    out = tmp_path / "volume.h5"
    command = ["recon", str(scan_file), "-o", str(out), "--quality", "fast", "--no-align"]
    assert main(command) == 130
    assert tps.Result.load(out).plan["stop"].value == "interrupted"


def test_the_command_finishes_writing(scan_file, tmp_path, monkeypatch):
    import tomo_polysplat.result.files as module

    monkeypatch.setattr(module, "save_hdf5", interrupting(module.save_hdf5))
    out, report = tmp_path / "volume.h5", tmp_path / "report.html"
    options = ["--set", "passes=1", "--report", str(report)]
    assert main(["recon", str(scan_file), "-o", str(out), *options]) == 130
    assert tps.Result.load(out).volume.max() > 0.1 and report.exists()


def test_the_command_resumes(scan_file, tmp_path, capsys):
    kept, outputs = str(tmp_path / "fit.npz"), [str(tmp_path / f"{name}.npy") for name in "ab"]
    command = ["recon", str(scan_file), "--set", "passes=2", "--checkpoint", kept, "-o"]
    assert main([*command, outputs[0]]) == 0
    assert main([*command, outputs[1]]) == 2 and "pass --resume" in capsys.readouterr().err
    assert main([*command, outputs[1], "--resume"]) == 0
    assert np.array_equal(*map(np.load, outputs))
    assert main([*command, outputs[1], "--overwrite", "--resume", "--seed", "3"]) == 2
    assert "'seed': 3" in capsys.readouterr().err
