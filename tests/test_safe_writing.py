"""Whatever a write runs into, the old file or the whole new one is there, and the process and its result live."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from campaign.forks import child

import tomo_polysplat as tps
from tomo_polysplat import folders
from tomo_polysplat.cli.main import main
from tomo_polysplat.file_lock import FileLock
from tomo_polysplat.files import replacing, write_text
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan import hdf5_writer
from tomo_polysplat.scan.geometry import VolumeGrid
from tomo_polysplat.scan.io import load_scan, save_scan

WRITE = os.pwrite
ENDINGS = ("h5", "npy", "tif", "ome.tif", "mha", "nrrd", "nii", "nii.gz", "vti")


def result(value=None, slices=5, passes=50):
    grid = VolumeGrid((slices, 7, 9), np.zeros(3), np.ones(3))
    mu = (
        np.random.default_rng(0).random((1, *grid.shape))
        if value is None
        else np.full((1, *grid.shape), value)
    )
    history = [{"seconds": float(i), "iteration": i, "loss": 1.0, "held_out": None} for i in range(passes)]
    return Result(mu, grid, "cm", 50.0, history=history)


def names(folder):
    return sorted(os.listdir(folder))


# Disks that fill up


def save_under_limits():
    """In the folder where it is, under every writer, with room for ever more of the file."""
    import resource

    whole = result()
    for ending in ENDINGS:
        whole.save(f"size.{ending}")
    for ending in (*ENDINGS, "slices/"):
        size = os.path.getsize(f"size.{ending}") if ending != "slices/" else 900
        for share in np.linspace(0.05, 0.98, 9):
            path = "v." + ending
            resource.setrlimit(resource.RLIMIT_FSIZE, (int(share * size), resource.RLIM_INFINITY))
            with pytest.raises(OSError, match="."):
                whole.save(path, overwrite=True)
            resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            assert not [name for name in names(".") if ".part" in name], names(".")
            assert not os.path.exists(path)
    whole.save("v.h5")


@pytest.mark.skipif(sys.platform == "win32", reason="limits on the size of files are of Unix")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_no_limit_on_a_file_ends_the_process_or_leaves_a_part(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # A status below 0 is the signal that the system sends beyond the limit.
    assert child(save_under_limits) == 0 and Path("v.h5").exists()


class FailingDisk:
    """`os.pwrite` that writes a few bytes at a time, and from its n-th call on none."""

    def __init__(self, last, code=errno.ENOSPC):
        self.left, self.code = last, code

    def __call__(self, file, data, offset):
        self.left -= 1
        if self.left < 0:
            raise OSError(self.code, os.strerror(self.code))
        return WRITE(file, data[:700], offset)


@pytest.mark.parametrize("what", ["result", "scan"])
def test_hdf5_survives_a_write_that_fails_anywhere(tmp_path, monkeypatch, what):
    path = tmp_path / "v.h5"
    scan = tps.simulate_scan("pins", size=8, views=6)
    whole = result()
    save = (
        whole.save if what == "result" else lambda path, overwrite: save_scan(scan, path, overwrite=overwrite)
    )
    path.write_text("the old one")
    failures = 0
    for last in range(200):
        disk = FailingDisk(last, errno.EIO if last % 2 else errno.ENOSPC)
        monkeypatch.setattr(hdf5_writer.os, "pwrite", disk)
        try:
            save(path, overwrite=True)
            break
        except OSError:
            failures += 1
        assert path.read_text() == "the old one" and names(tmp_path) == ["v.h5"]
    assert 5 < failures < 199
    monkeypatch.undo()
    if what == "result":
        np.testing.assert_array_equal(Result.load(path).volume, whole.volume)
    else:
        np.testing.assert_array_equal(load_scan(path).projections, scan.projections)


def test_a_file_system_that_takes_no_room_ahead_is_written_to(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.EOPNOTSUPP, "not here")

    monkeypatch.setattr(hdf5_writer.os, "posix_fallocate", refuse, raising=False)
    result().save(tmp_path / "v.h5")
    np.testing.assert_array_equal(Result.load(tmp_path / "v.h5").volume, result().volume)


def test_no_room_is_left_over_in_a_file(tmp_path):
    """What was taken ahead and not needed is given back, also where a smaller result replaces a larger one."""
    path = tmp_path / "v.h5"
    result(slices=40).save(path)
    result(slices=2).save(path, overwrite=True)
    assert path.stat().st_size < 2 * 4 * 2 * 7 * 9 + 30_000


# Names and links


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_name_may_be_as_long_as_the_system_lets_it(tmp_path, ending):
    longest = os.pathconf(tmp_path, "PC_NAME_MAX")
    name = "é" * ((longest - len(ending) - 1) // 2) + "." + ending
    result().save(tmp_path / name)
    assert names(tmp_path) == [name]
    with pytest.raises(ValueError, match="names of at most"):
        result().save(tmp_path / ("éé" + name))


@pytest.mark.parametrize("name", ["a\0b.h5", "", b"a\0b.h5"])
def test_names_that_no_file_can_have_are_refused(name):
    with pytest.raises(ValueError, match=r"name of a file|name ending in"):
        result().save(name)
    with pytest.raises(ValueError, match="path: expected the name of a file"):
        write_text(name, "", overwrite=True)


def test_a_name_in_bytes_is_a_name(tmp_path):
    result().save(os.fsencode(tmp_path / "é.h5"))
    assert names(tmp_path) == ["é.h5"]


def test_a_link_stays_and_its_file_is_replaced(tmp_path):
    (tmp_path / "far").mkdir()
    (tmp_path / "far/real.npy").write_text("old")
    (tmp_path / "link.npy").symlink_to("far/real.npy")
    with pytest.raises(FileExistsError):
        result().save(tmp_path / "link.npy")
    result().save(tmp_path / "link.npy", overwrite=True)
    assert (tmp_path / "link.npy").is_symlink() and names(tmp_path / "far") == ["real.npy"]
    np.testing.assert_array_equal(np.load(tmp_path / "far/real.npy"), result().volume)


@pytest.mark.parametrize("target", ["nowhere.h5", "link.h5"])
def test_a_link_to_nothing_is_refused(tmp_path, target):
    (tmp_path / "link.h5").symlink_to(target)
    for overwrite in (False, True):
        with pytest.raises(FileNotFoundError, match="a link to nothing"):
            result().save(tmp_path / "link.h5", overwrite=overwrite)
    assert names(tmp_path) == ["link.h5"]


def test_the_names_that_files_have_while_they_are_written_cannot_be_foreseen(tmp_path):
    seen = set()
    for _ in range(3):
        with replacing(tmp_path / "v.h5", overwrite=True) as temporary:
            seen.add(temporary.name)
    assert len(seen) == 3


# Folders of slices


def stack(folder):
    import tifffile

    return [float(tifffile.imread(folder / name).max()) for name in names(folder) if name.startswith("slice")]


def test_a_lower_stack_leaves_nothing_of_a_taller_one(tmp_path):
    result(1.0, 12).save_tiff(tmp_path / "s")
    (tmp_path / "s/.DS_Store").touch()
    result(2.0, 3).save_tiff(tmp_path / "s", overwrite=True)
    assert stack(tmp_path / "s") == [2.0] * 3 and names(tmp_path) == ["s"]


def failing_at(number, monkeypatch):
    import tifffile

    write, calls = tifffile.imwrite, []

    def imwrite(*args, **options):
        calls.append(1)
        if len(calls) == number:
            raise OSError(errno.ENOSPC, "full")
        return write(*args, **options)

    monkeypatch.setattr(tifffile, "imwrite", imwrite)


@pytest.mark.parametrize("number", [1, 3, 5])
@pytest.mark.parametrize("old", [True, False])
def test_a_stack_that_fails_leaves_the_old_one(tmp_path, monkeypatch, number, old):
    if old:
        result(1.0, 4).save_tiff(tmp_path / "s")
    failing_at(number, monkeypatch)
    with pytest.raises(OSError, match="full"):
        result(2.0).save_tiff(tmp_path / "s", overwrite=True)
    assert names(tmp_path) == (["s"] if old else []) and (not old or stack(tmp_path / "s") == [1.0] * 4)


def test_without_an_exchange_the_old_stack_comes_back_when_the_new_one_cannot_take_its_place(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(folders, "_exchanged", lambda *_: False)
    result(1.0).save_tiff(tmp_path / "s")
    result(2.0).save_tiff(tmp_path / "s", overwrite=True)
    assert stack(tmp_path / "s") == [2.0] * 5 and names(tmp_path) == ["s"]
    rename, calls = os.rename, []

    def second_fails(old, new):
        calls.append(1)
        if len(calls) == 2:
            raise OSError(errno.EIO, "broken")
        rename(old, new)

    monkeypatch.setattr(folders.os, "rename", second_fails)
    with pytest.raises(OSError, match="broken"):
        result(3.0).save_tiff(tmp_path / "s", overwrite=True)
    assert stack(tmp_path / "s") == [2.0] * 5 and names(tmp_path) == ["s"]


@pytest.mark.parametrize("name", ["notes.txt", "slice_0001.tif", "slice_mask.tif", "sub"])
def test_no_foreign_file_is_touched(tmp_path, name):
    import tifffile

    folder = tmp_path / "s"
    result(1.0, 2).save_tiff(folder)
    (folder / name).unlink(missing_ok=True)
    if name == "sub":
        (folder / name).mkdir()
    else:
        tifffile.imwrite(folder / name, np.zeros((3, 3)), software="another program")
    before = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    with pytest.raises(FileExistsError, match="nothing but slices"):
        result(2.0).save_tiff(folder, overwrite=True)
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == before


def test_what_comes_into_the_folder_at_the_last_moment_is_kept(tmp_path, monkeypatch):
    folder = tmp_path / "s"
    result(1.0).save_tiff(folder)
    take = folders._take_place

    def late(new, target):
        (target / "notes.txt").write_text("precious")
        take(new, target)

    monkeypatch.setattr(folders, "_take_place", late)
    result(2.0, 3).save_tiff(folder, overwrite=True)
    assert (folder / "notes.txt").read_text() == "precious" and stack(folder) == [2.0] * 3
    assert names(tmp_path) == ["s"]


def test_the_folder_one_is_in_is_not_replaced(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="in which you are"):
        result().save_tiff(".")


# One run a checkpoint

HOLDING = """
import sys
from pathlib import Path
from tomo_polysplat.file_lock import FileLock
lock = FileLock(Path(sys.argv[1]))
print("held", flush=True)
sys.stdin.read()
"""


def test_a_lock_is_of_one_process_and_ends_with_it(tmp_path):
    pytest.importorskip("fcntl")
    path = tmp_path / "fit.npz"
    command = [sys.executable, "-c", HOLDING, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(BlockingIOError, match="checkpoint: .*another run writes"):
            FileLock(path, "checkpoint")
        other.kill()
        other.wait()
    first, second = FileLock(path), FileLock(path)
    first.release()
    assert names(tmp_path) == [".fit.npz.lock"], "the second still has it"
    second.release()
    assert names(tmp_path) == []


# The command line


@pytest.fixture
def solved(monkeypatch):
    """The command without its work: a result as large as the scan's volume."""
    monkeypatch.setattr(tps, "reconstruct", lambda *_, **__: result())


def run(*command):
    return main([str(part) for part in command])


def test_an_output_that_is_read_is_refused(scan_file, tmp_path, capsys):
    table = tmp_path / "table.h5"
    table.write_text("30 1\n60 2\n")
    (tmp_path / "other.h5").symlink_to(table)
    for output in (table, tmp_path / "other.h5", tmp_path / "sub" / ".." / "table.h5"):
        (tmp_path / "sub").mkdir(exist_ok=True)
        assert run("recon", scan_file, "-o", output, "--spectrum", table, "--overwrite") == 2
        assert "one file twice" in capsys.readouterr().err
    assert table.read_text() == "30 1\n60 2\n"


@pytest.mark.parametrize("option", ["-o", "--report", "--json", "--checkpoint"])
def test_nothing_else_is_written_into_the_folder_of_slices(scan_file, tmp_path, capsys, option):
    (tmp_path / "s").mkdir()
    other = [] if option == "-o" else ["-o", tmp_path / "v.h5"]
    assert run("recon", scan_file, *other, option, tmp_path / "s/f.npy", "--tiff", tmp_path / "s") == 2
    assert "a folder of its own" in capsys.readouterr().err


@pytest.mark.parametrize("ending", [*ENDINGS, "stack/", "ome.zarr"])
def test_the_ending_decides_what_recon_writes(scan_file, tmp_path, solved, capsys, ending):
    options = [] if ending in ("h5", "npy") else ["--bits", "16"]
    output = f"{tmp_path}/new/v.{ending}" if ending == "stack/" else f"{tmp_path}/v.{ending}"
    assert run("recon", scan_file, "-o", output, *options) == 0
    assert f"wrote {output}" in capsys.readouterr().out and Path(output).exists()


def test_a_result_that_cannot_be_written_is_rescued_and_the_rest_is_written(
    scan_file, tmp_path, solved, monkeypatch, capsys
):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr("tomo_polysplat.result.image_files.write_nrrd", full)
    output, about = tmp_path / "v.nrrd", tmp_path / "about.json"
    assert run("recon", scan_file, "-o", output, "--json", about) == 2
    said = capsys.readouterr()
    assert "full" in said.err and about.exists() and not output.exists()
    (rescued,) = (tmp_path / "temporary").glob("*/rescued.h5")
    assert str(rescued) in said.out
    np.testing.assert_array_equal(Result.load(rescued).volume, result().volume)
