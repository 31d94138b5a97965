"""Texts of files are shown without what would move the cursor, colour the terminal or turn the line round."""

import json
import logging

import h5py
import numpy as np
import pytest
from small_scans import fan

import tomo_polysplat as tps
from tomo_polysplat.checks import fail, visible
from tomo_polysplat.cli.main import main
from tomo_polysplat.json_text import parse_json
from tomo_polysplat.plan.answer import Answer
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.geometry import VolumeGrid
from tomo_polysplat.scan.io import load_scan, save_scan

# Red letters, a cleared line, a title of the window, a turned direction, a line separator, half a pair, a bell.
HOSTILE = "a\x1b[31mb\r\x1b[2K\x9b1mc\x1b]0;t\x07\u202egnp\u2028\u200b\ud800\x00z"


def harmless(text):
    return all(character.isprintable() or character in "\n\xa0" for character in text)


def test_what_can_be_read_stays_as_it_is():
    for text in ("Ölprobe 3 µm", "試料", "naïve – “quoted”", "a\\x1b", "x\u00a0y", ""):
        assert visible(text) == text
    assert visible("a\nb\tc") == "a b c"


def test_what_cannot_be_read_becomes_its_number():
    shown = visible(HOSTILE)
    assert harmless(shown) and len(shown) > len(HOSTILE)
    for part in ("\\x1b[31mb", "\\x9b1m", "\\u202egnp", "\\u2028", "\\u200b", "\\ud800", "\\x00z"):
        assert part in shown


def test_errors_show_texts_harmlessly():
    assert harmless(str(fail(HOSTILE, "a name", HOSTILE, HOSTILE)))


def renamed(tmp_path, name):
    """A scan whose sample and spectrum have hostile names."""
    path = tmp_path / "scan.h5"
    save_scan(fan(), path)
    with h5py.File(path, "r+") as file:
        del file["measurement/sample/name"]
        file["measurement/sample/name"] = name
        file["polysplat/spectrum"].attrs["label"] = name
    return path


def test_a_scan_with_a_hostile_name_is_harmless_in_terminal_log_and_report(tmp_path, capfd):
    name = HOSTILE.replace("\ud800", "").replace("\x00", "")
    path, report, about = renamed(tmp_path, name), tmp_path / "r.html", tmp_path / "a.json"
    options = ["--set", "passes=1", "--no-calibrate", "--report", str(report), "--json", str(about)]
    assert main(["recon", str(path), "-o", str(tmp_path / "v.h5"), "-v", *options]) == 0
    said = capfd.readouterr()
    scan = load_scan(path)
    assert harmless(scan.name) and harmless(scan.spectrum.label) and "\\x1b[31mb" in scan.name
    assert "\\x1b[31mb" in said.out and harmless(said.out)
    page = report.read_text(encoding="utf-8")
    assert "\\x1b[31mb" in page and harmless(page)
    assert harmless(json.loads(about.read_text())["provenance"]["scan"])


def test_a_hostile_result_is_harmless_in_its_report(tmp_path):
    grid = VolumeGrid((3, 4, 5), np.zeros(3), np.ones(3))
    words = {HOSTILE: Answer.found(HOSTILE), "deep": Answer.found({HOSTILE: HOSTILE}, HOSTILE)}
    result = Result(np.ones((1, *grid.shape)), grid, plan=words, provenance={"scan": HOSTILE})
    result.report(tmp_path / "r.html")
    assert harmless((tmp_path / "r.html").read_text(encoding="utf-8"))


def test_the_log_of_the_command_line_is_harmless(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(logging.root, "handlers", [])
    path = tmp_path / "no\x1b[31mfile.h5"
    assert main(["recon", str(path), "-o", str(tmp_path / "v.h5")]) == 2
    logging.getLogger("tomo_polysplat.any").warning("the sample is %s", HOSTILE)
    said = capsys.readouterr().err
    assert harmless(said) and "no\\x1b[31mfile" in said and "WARNING: the sample is a\\x1b" in said


# JSON


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 60 + "]" * 60, "nested at most 50 deep, got 60"),
        ('{"a":' * 51 + "1" + "}" * 51, "got 51"),
        ("[" + "{}," * 1_000_001 + "{}]", "at most 1000000 values"),
        ("[" + "9" * 4000 + "]", "4000 digits"),
        ("[1e999]", "the number 1e999"),
        ("[NaN]", "the number NaN"),
        ("[-Infinity]", "the number -Infinity"),
        ("[1", "delimiter"),
        ("]" * 10, "Expecting value"),
        ('["' + r"\"" * 300_000, "Unterminated string"),
    ],
)
def test_more_than_an_honest_file_says_is_refused(text, message):
    with pytest.raises(ValueError, match=f"/plan: expected JSON.*{message}"):
        parse_json(text, "/plan")


def test_json_says_what_it_says():
    deep = '{"brackets": "[[[[{{\\"", "n": [1, 2.5, -3e-7, true, null]}'
    assert parse_json(deep, "") == json.loads(deep)
    assert parse_json("[" * 50 + "]" * 50, "") == json.loads("[" * 50 + "]" * 50)
    assert parse_json('["' + "[" * 99 + '"]', "") == ["[" * 99]
    assert parse_json("[Infinity]", "", finite=False) == [np.inf]


# Numbers of results


def damaged(path, name, value):
    with h5py.File(path, "r+") as file:
        file[f"polysplat/{name}"][...].shape  # noqa: B018  # it is there
        file[f"polysplat/{name}"][(-1,) * file[f"polysplat/{name}"].ndim] = value


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30])
@pytest.mark.parametrize(
    "name", ["basis", *(f"gaussians/{part}" for part in ("position", "scale", "rotation", "density", "u"))]
)
def test_a_result_with_a_damaged_number_is_refused(tmp_path, name, value):
    grid = VolumeGrid((3, 4, 5), np.zeros(3), np.ones(3))
    cloud = {"position": (3,), "scale": (3,), "rotation": (4,), "density": (), "u": ()}
    gaussians = {part: np.full((2, *tail), 0.5, np.float32) for part, tail in cloud.items()}
    tps.Result(np.ones((1, *grid.shape)), grid, gaussians=gaussians).save(tmp_path / "r.h5")
    tps.Result.load(tmp_path / "r.h5")
    damaged(tmp_path / "r.h5", name, value)
    with pytest.raises(ValueError, match=f"/polysplat/{name}: expected finite numbers.*damaged"):
        tps.Result.load(tmp_path / "r.h5")


def test_a_slices_gaussians_have_no_end_along_z_and_no_other_infinity(tmp_path):
    scan = fan()
    settings = {"passes": 1.0}
    result = tps.reconstruct(scan.projections, scan.proj_geom, scan.vol_geom, settings=settings)
    assert np.isinf(result.gaussians["scale"][:, 2]).all()
    result.save(tmp_path / "r.h5")
    tps.Result.load(tmp_path / "r.h5")
    with h5py.File(tmp_path / "r.h5", "r+") as file:
        file["polysplat/gaussians/scale"][0, 1] = np.inf
    with pytest.raises(ValueError, match="gaussians/scale"):
        tps.Result.load(tmp_path / "r.h5")
