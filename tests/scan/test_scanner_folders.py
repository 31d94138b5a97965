"""Every kind of scanner's folder gives the volume of the package's own file."""

import subprocess
import sys

import pytest
from folders import marked, require_the_same_volume

import tomo_polysplat as tps
from tomo_polysplat.simulate.folders.write import KINDS, write_folder


@pytest.mark.parametrize("kind", KINDS)
def test_a_folder_gives_the_volume_of_our_own_file(kind, tmp_path):
    own = write_folder(kind, tmp_path / "folder", marked())
    tps.save_scan(own, tmp_path / "own.h5")
    scan = tps.load_scan(tmp_path / "folder")
    require_the_same_volume(scan, tps.load_scan(tmp_path / "own.h5"))
    # What the folder tells of the tube makes the spectrum that the scan was made with.
    assert scan.spectrum.effective_energy == pytest.approx(own.spectrum.effective_energy)
    assert any("flat panel" in guess for guess in scan.notes["scanner"]["guessed"])


def test_a_folder_is_not_written_over(tmp_path):
    (tmp_path / "mine.txt").write_text("keep me")
    with pytest.raises(FileExistsError, match="a new or empty folder"):
        write_folder("tiffs", tmp_path, marked())


def test_two_commands_from_a_folder_to_a_file(tmp_path):
    write_folder("tiffs", tmp_path / "folder", marked())
    command = [
        sys.executable,
        "-m",
        "tomo_polysplat.cli.main",
        "import",
        "folder",
        "-o",
        "scan.h5",
        "--views",
        "2",
    ]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=True)
    assert "wrote scan.h5" in done.stdout and "flat panel" in done.stderr
    scan = tps.load_scan(tmp_path / "scan.h5")
    assert scan.views == 24 and scan.unit == "mm" and scan.notes["scanner"]["keys"] == {"operator": "nobody"}
