"""Ctrl-C, killed processes, full disks and folders that cannot be written to lose nothing."""

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from small_scans import QUICK, fan, reconstruct

import tomo_polysplat as tps
from tomo_polysplat.cli.main import main
from tomo_polysplat.files import replacing
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.interrupts import postponed_interrupts
from tomo_polysplat.scan.io import save_scan

MANY = QUICK | {"passes": 10_000.0, "patience": 10_000}


@pytest.fixture
def scan_file(tmp_path):
    path = tmp_path / "scan.npz"
    save_scan(fan(), path)
    return path


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


# Ctrl-C by stage


def test_in_the_start_stage_it_says_that_there_is_no_result(monkeypatch, tmp_path):
    path = tmp_path / "fit.npz"
    start = interrupting(lambda *_: None)
    monkeypatch.setattr("tomo_polysplat.fit.problem.Problem.start_volume", start)
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
        fan(), settings=MANY, progress=lambda share, words: began.set() if share > 0 else None
    )
    thread.join()
    assert result.plan["stop"] == "interrupted" and result.history
    assert np.isfinite(result.volume).all() and result.volume.max() > 0.1


def test_in_the_first_pass_it_returns_a_physical_volume(monkeypatch):
    monkeypatch.setattr(FitScene, "projections", interrupting(FitScene.projections))
    result = reconstruct(fan())
    assert result.plan["stop"] == "interrupted" and not result.history
    assert result.volume.max() > 0.1 and result.volume.min() >= 0


def test_during_the_volume_the_volume_is_finished(monkeypatch, caplog):
    whole = reconstruct(fan())
    monkeypatch.setattr(FitScene, "basis", interrupting(FitScene.basis))
    result = reconstruct(fan())
    assert np.array_equal(result.volume, whole.volume)
    assert result.plan["stop"] == whole.plan["stop"] + ", then interrupted"
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
        "settings": MANY,
        "callbacks": [lambda state: ctrl_c()],
        "on_result": results.append,
    }
    centre = np.full(2, 36, np.float32)
    tps.polysplat(tomo, centre, recon, theta, num_gridx=72, num_gridy=72, options=options)
    assert results[0].plan["stop"] == "interrupted" and recon.max() > 0


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
    assert main(["recon", str(scan_file), "-o", str(out), "--quality", "fast"]) == 130
    assert tps.Result.load(out).plan["stop"] == "interrupted"


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


# What stays of a killed process


KILLED = """
import os, signal, sys
from pathlib import Path
from tomo_polysplat.files import replacing
with replacing(Path(sys.argv[1]), overwrite=True) as temporary:
    temporary.write_bytes(b"half of the new")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_process_killed_while_writing_leaves_the_old_file(tmp_path):
    path = tmp_path / "volume.h5"
    path.write_bytes(b"the old one")
    done = subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False)
    assert done.returncode == -signal.SIGKILL and path.read_bytes() == b"the old one"


def test_a_checkpoint_is_complete_whenever_it_is_there(tmp_path, monkeypatch):
    """An archive is only ever seen under its name once its last byte is written."""
    path, seen = tmp_path / "fit.npz", []
    write = np.savez

    def half_written(file, **arrays):
        seen.append(path.exists())
        write(file, **arrays)
        if len(seen) > 1:
            file.truncate(100)
            raise OSError("killed here")

    monkeypatch.setattr("tomo_polysplat.fit.checkpoint._LARGEST_SHARE", 1e9)
    monkeypatch.setattr(np, "savez", half_written)
    reconstruct(fan(), checkpoint=path, settings=QUICK | {"passes": 3.0})
    assert seen == [False, True, True]
    monkeypatch.undo()
    resumed = reconstruct(fan(), checkpoint=path, resume=True, settings=QUICK | {"passes": 3.0})
    assert len(resumed.history) == 3


# Disks and folders


@pytest.fixture
def no_solver(monkeypatch):
    def solve(*_, **__):
        raise AssertionError("the work began before the outputs were checked")

    monkeypatch.setattr(tps, "reconstruct", solve)
    monkeypatch.setattr("tomo_polysplat.simulate.scenes.simulate_scan", solve)


def refused(command, capsys):
    assert main([str(part) for part in command]) == 2
    return capsys.readouterr().err


@pytest.mark.parametrize("suffix", ["h5", "npy"])
def test_a_full_disk_is_found_before_the_work(scan_file, tmp_path, monkeypatch, no_solver, capsys, suffix):
    voxels = 48 * 48 * 4
    needed = voxels * (4 if suffix == "h5" else 1) + voxels
    command = ["recon", scan_file, "-o", tmp_path / f"volume.{suffix}", "--tiff", tmp_path / "new/slices"]
    free = SimpleNamespace(free=needed - 1)
    monkeypatch.setattr("tomo_polysplat.files.shutil.disk_usage", lambda _: free)
    assert "free disk space" in refused(command, capsys)
    free.free = needed
    with pytest.raises(AssertionError, match="the work began"):
        main([str(part) for part in [*command, "--debug"]])


def test_a_full_disk_is_found_before_a_simulation(tmp_path, monkeypatch, no_solver, capsys):
    monkeypatch.setattr("tomo_polysplat.files.shutil.disk_usage", lambda _: SimpleNamespace(free=1000))
    assert "free disk space" in refused(["simulate", "pins", "-o", tmp_path / "scan.h5"], capsys)


@pytest.mark.parametrize("option", ["-o", "--report", "--json", "--tiff", "--checkpoint"])
def test_a_folder_that_cannot_be_written_to_is_found_before_the_work(
    scan_file, tmp_path, monkeypatch, no_solver, capsys, option
):
    """Refused by the system, not by its permissions, which mean nothing to an administrator."""
    if option == "--checkpoint":
        monkeypatch.undo()  # reconstruct itself looks at this folder, before it starts
    (tmp_path / "locked").mkdir()
    make = tempfile.TemporaryFile

    def guarded(*args, dir=None, **options):
        if "locked" in str(dir):
            raise PermissionError(13, "Permission denied")
        return make(*args, dir=dir, **options)

    monkeypatch.setattr("tomo_polysplat.files.tempfile.TemporaryFile", guarded)
    names = {
        "-o": "v.h5",
        "--report": "r.html",
        "--json": "r.json",
        "--tiff": "slices",
        "--checkpoint": "c.npz",
    }
    target = tmp_path / "locked" / names[option]
    command = ["recon", scan_file, *([] if option == "-o" else ["-o", tmp_path / "v.h5"]), option, target]
    assert "Permission denied" in refused(command, capsys)
    assert not (tmp_path / "v.h5").exists()


def test_nothing_is_replaced_without_being_asked(scan_file, tmp_path, no_solver, capsys):
    slices = tmp_path / "slices"
    slices.mkdir()
    (slices / "slice_0000.tif").write_text("precious")
    command = ["recon", scan_file, "-o", tmp_path / "v.h5"]
    assert "1 in" in refused([*command, "--tiff", slices], capsys)
    for option in ("--report", "--json"):
        assert "which exists" in refused([*command, option, scan_file], capsys)
    for option in ("--report", "--json", "--checkpoint"):
        assert "twice" in refused([*command, option, tmp_path / "v.h5"], capsys)
    assert "twice" in refused(
        ["recon", scan_file, "-o", tmp_path / "v.h5", "--overwrite", "--json", scan_file], capsys
    )
    assert (slices / "slice_0000.tif").read_text() == "precious"


def test_a_file_that_appears_meanwhile_is_not_replaced(tmp_path):
    path = tmp_path / "volume.h5"
    with pytest.raises(FileExistsError), replacing(path, overwrite=False) as temporary:
        temporary.write_text("new")
        path.write_text("somebody else's")
    assert path.read_text() == "somebody else's" and os.listdir(tmp_path) == ["volume.h5"]
