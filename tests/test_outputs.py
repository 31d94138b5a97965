"""Killed processes, full disks and folders that cannot be written to lose nothing."""

import os
import signal
import subprocess
import sys
import tempfile
from types import SimpleNamespace

import numpy as np
import pytest
from small_scans import QUICK, fan, reconstruct

import tomo_polysplat as tps
from tomo_polysplat.cli.main import main
from tomo_polysplat.files import replacing, write_text
from tomo_polysplat.simulate.scenes import scan_bytes, simulate_scan

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

    monkeypatch.setattr("tomo_polysplat.plan.checkpoint._LARGEST_SHARE", 1e9)
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
    assert "nothing but slices" in refused([*command, "--tiff", slices, "--overwrite"], capsys)
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


def test_a_new_file_has_the_usual_permissions_and_a_replaced_one_those_it_had(tmp_path):
    (tmp_path / "usual").touch()
    path = tmp_path / "volume.h5"
    for permissions in ((tmp_path / "usual").stat().st_mode, 0o100640):
        if path.exists():
            path.chmod(permissions)
        write_text(path, "new", overwrite=True)
        assert path.stat().st_mode == permissions


def test_the_room_that_a_simulation_needs_is_what_it_writes(tmp_path):
    for geometry in ("cone", "fan", "parallel"):
        scan = simulate_scan("pins", 13, 7, geometry=geometry)
        arrays = (scan.projections, np.ones_like(scan.projections, bool), scan.truth, scan.metal_mask)
        assert scan_bytes(13, 7, geometry) == sum(array.nbytes for array in arrays)
