"""What the command line says to a slip: what is wrong first, then what was meant, in a few lines."""

import os

import numpy as np
import pytest
import tifffile

from tomo_polysplat.cli import main
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.geometry import VolumeGrid

RECON = ["recon", "scan.h5", "-o", "out.h5"]


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["recn", "scan.h5"], "'recn': did you mean recon? expected one of demo, "),
        (["teleport"], "'teleport': expected one of demo, "),
        ([*RECON, "--qualty", "fast"], "recon: error: unknown: --qualty fast; did you mean --quality?"),
        ([*RECON, "--qual", "fast"], "unknown: --qual fast; did you mean --quality?"),
        ([*RECON, "--time=3"], "unknown: --time=3; did you mean --time-budget?"),
        (
            [*RECON, "--quality", "fastt"],
            "--quality: 'fastt': did you mean fast? expected one of fast, balanced",
        ),
        ([*RECON, "--bits", "8"], "argument --bits: 8: expected one of 16, 32"),
        (["recon", "scan.h5"], "required: -o/--output"),
    ],
)
def test_a_slip_is_told_before_anything_else(argv, says, capsys):
    with pytest.raises(SystemExit) as ended:
        main(argv)
    said = capsys.readouterr().err
    assert ended.value.code == 2
    first, *rest = said.splitlines()
    assert says in first and "usage" not in said and len(rest) == 1 and "--help tells" in rest[0]


def test_a_memory_in_words_is_refused_before_the_scan_is_looked_for(tmp_path, capsys):
    out = str(tmp_path / "out.h5")
    assert main(["recon", "nowhere.h5", "-o", out, "--memory", "lots"]) == 2
    assert "expected bytes" in capsys.readouterr().err


def test_a_reader_that_goes_away_is_no_error(monkeypatch, capfd):
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as nobody:
        monkeypatch.setattr("sys.stdout", nobody)
        assert main(["completion", "bash"]) == 141
    assert not capfd.readouterr().err


def files_of_other_kinds(folder):
    tifffile.imwrite(folder / "slice.tif", np.zeros((4, 5), np.uint16))
    (folder / "slices").mkdir()
    Result(np.zeros((1, 3, 4, 5)), VolumeGrid((3, 4, 5), (-1, -1, -1), (1, 1, 1))).save(folder / "result.h5")
    assert main(["simulate", "pins", "--size", "8", "--views", "6", "-o", str(folder / "scan.h5")]) == 0


def test_a_file_of_another_kind_is_told_what_to_do(tmp_path, capsys):
    files_of_other_kinds(tmp_path)
    for name, remedy in (
        ("slice.tif", "look at a TIFF in ImageJ"),
        ("slices", "which is a folder; name a file in it"),
        ("scan.h5", "a scan is reconstructed first, by `tomo-polysplat recon SCAN -o RESULT.h5`"),
    ):
        capsys.readouterr()
        assert main(["view", str(tmp_path / name), "--no-browser"]) == 2
        said = capsys.readouterr().err
        assert remedy in said and len(said.splitlines()) == 1, name
