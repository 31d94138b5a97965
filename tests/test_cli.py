"""The command line: what it writes, what it says, and how it refuses."""

import json
import logging
import sys
from dataclasses import replace
from types import ModuleType

import h5py
import numpy as np
import pytest

import tomo_polysplat
from tomo_polysplat.cli import main
from tomo_polysplat.cli.main import _FirstTime, _VisibleFormatter
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.scan.io import load_scan, save_scan

SIMULATE = ["simulate", "pins", "--size", "10", "--views", "8"]


@pytest.fixture
def scan_file(tmp_path):
    assert main([*SIMULATE, "-o", str(tmp_path / "scan.h5")]) == 0
    return tmp_path / "scan.h5"


@pytest.fixture
def solver(monkeypatch):
    """Stands in for the solver: water everywhere, and the arguments it was called with."""
    calls = []

    def reconstruct(scan, **options):
        correction = None if scan.spectrum is None else scan.water_correction
        own = {"spectrum": scan.spectrum, "unit": scan.unit, "valid": scan.usable}
        options = own | {"water_correction": correction} | options
        calls.append(options | {"shape": scan.projections.shape})
        options["progress"](0.5, "half way")
        grid = from_astra(scan.proj_geom, scan.vol_geom)[1]
        if options["spectrum"] is None:
            return Result(np.ones((1, *grid.shape)), grid, options["unit"])
        basis = np.zeros((3, *grid.shape))
        basis[0] = 1.0
        energy = options["spectrum"].effective_energy
        return Result(basis, grid, options["unit"], energy, Materials(), options["spectrum"], seconds=2.0)

    monkeypatch.setitem(vars(tomo_polysplat), "reconstruct", reconstruct)
    return calls


def test_simulate_writes_a_scan_that_loads(scan_file):
    scan = load_scan(scan_file)
    assert scan.views == 8 and scan.volume_shape == (10, 10, 10)
    assert scan.truth is not None and scan.metal_mask.any() and scan.spectrum is not None


def test_simulate_takes_a_spectrum_and_leaves_the_metal_out(tmp_path, capsys):
    path = str(tmp_path / "scan.npz")
    options = [
        "--kvp",
        "120",
        "--filter",
        "Al:0.2",
        "--filter",
        "Cu:0.05",
        "--detector",
        "integrating:CsI:0.06",
    ]
    assert main([*SIMULATE, "-o", path, "--metal", "none", *options]) == 0
    assert f"wrote {path}" in capsys.readouterr().out
    scan = load_scan(path)
    assert not scan.metal_mask.any() and scan.spectrum.energies.max() > 110
    assert "Cu" in scan.spectrum.label


def test_recon_writes_all_that_was_asked_for(scan_file, tmp_path, solver, capsys):
    out, page, slices, figures = (tmp_path / name for name in ("out.h5", "r.html", "slices", "out.json"))
    options = [
        "-o",
        out,
        "--report",
        page,
        "--tiff",
        slices,
        "--json",
        figures,
        "--seed",
        "7",
        "--set",
        "passes=3",
    ]
    assert main(["recon", *map(str, [scan_file, *options])]) == 0
    scan, result = load_scan(scan_file), Result.load(out)
    np.testing.assert_allclose(result.volume, mass_attenuation("water", result.energy_kev), rtol=1e-5)
    assert result.energy_kev == pytest.approx(scan.spectrum.effective_energy)
    assert len(list(slices.iterdir())) == 10 and "<html" in page.read_text()
    about = json.loads(figures.read_text())
    error = (result.volume - scan.truth)[~scan.metal_mask]
    assert about["errors"]["rmse"] == pytest.approx(np.sqrt(np.mean(error**2)))
    assert about["unit"] == "cm" and about["seconds"] == 2.0
    assert (
        solver[0]["seed"] == 7
        and solver[0]["settings"] == {"passes": 3}
        and solver[0]["quality"] == "balanced"
    )
    printed = capsys.readouterr().out
    assert "PSNR without metal (dB)" in printed and all(
        f"wrote {path}" in printed for path in (out, page, slices)
    )


def test_recon_energy_spectrum_and_mono(scan_file, tmp_path, solver):
    out = tmp_path / "out.npy"
    base = ["recon", str(scan_file), "-o", str(out), "--overwrite"]
    assert main([*base, "--energy", "80"]) == 0
    np.testing.assert_allclose(np.load(out), mass_attenuation("water", 80.0), rtol=1e-5)
    assert main([*base, "--kvp", "60", "--filter", "Al:0.1"]) == 0
    assert solver[-1]["spectrum"].energies.max() < 60
    assert main([*base, "--mono"]) == 0
    assert solver[-1]["spectrum"] is None
    table = tmp_path / "lines.csv"
    table.write_text("# keV, weight\n40, 1\n60, 3\n")
    assert main([*base, "--spectrum", str(table)]) == 0
    assert solver[-1]["spectrum"].effective_energy == pytest.approx(55.0)


@pytest.mark.parametrize(
    ("options", "asked"),
    [
        ([], None),
        (["--no-calibrate"], False),
        (["--calibrate"], True),
        (["--calibrate", "scatter"], ["scatter"]),
    ],
)
def test_scatter_is_looked_for_unless_told_otherwise(scan_file, tmp_path, solver, options, asked):
    assert main(["recon", str(scan_file), "-o", str(tmp_path / "volume.h5"), *options]) == 0
    assert solver[0]["calibrate"] == asked


def test_recon_reads_counts_with_the_options_given(tmp_path, solver):
    path = tmp_path / "counts.h5"
    with h5py.File(path, "w") as file:
        file["exchange/data"] = np.exp(-np.random.default_rng(0).random((4, 2, 9)))
        file["exchange/theta"] = [0.0, 45, 90, 135]
    options = ["--input", "transmission", "--centre", "4.5", "--pixel-size", "0.5", "--unit", "mm"]
    assert main(["recon", str(path), "-o", str(tmp_path / "o.h5"), *options]) == 0
    assert Result.load(tmp_path / "o.h5").unit == "mm" and solver[0]["shape"] == (2, 4, 9)


def test_a_spectrum_without_the_size_of_a_pixel_is_refused_by_its_flag(tmp_path, solver, capsys):
    path = tmp_path / "scan.h5"
    with h5py.File(path, "w") as file:
        file["exchange/data"] = np.random.default_rng(0).random((4, 2, 9))
        file["exchange/theta"] = [0.0, 45, 90, 135]
        file["exchange/data"].attrs["values"] = "attenuation"
    command = ["recon", str(path), "-o", str(tmp_path / "o.h5"), "--centre", "4.5", "--input", "attenuation"]
    assert main([*command, "--kvp", "90", "--filter", "Al:0.1"]) == 2
    assert "--pixel-size: expected the size of a pixel" in capsys.readouterr().err and not solver
    assert main(command) == 0


def test_check_describes_a_scan(scan_file, capsys):
    assert main(["check", str(scan_file)]) == 0
    printed = capsys.readouterr().out
    assert "cone" in printed and "rays left out   0 of" in printed and "90 kVp" in printed
    assert "Nothing to mend" in printed and f"cannot answer {printed.count(chr(10) + '?')} of" in printed


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-o", "x.foo"], "--output: expected a name ending in"),
        (["-o", "scan.h5"], "pass --overwrite"),
        (["-o", "nowhere/x.h5"], "--output: expected a file in an existing folder"),
        (["-o", "x.h5", "--report", "."], "--report: expected a file"),
        (["-o", "x.h5", "--json", "nowhere/x.json"], "--json: expected a file in an existing folder"),
        (["-o", "x.h5", "--tiff", "scan.h5"], "--tiff: expected a folder"),
        (["-o", "x.h5", "--spectrum", "none.txt"], "--spectrum: expected an existing file"),
        (["-o", "x.h5", "--filter", "Al:0.1"], "--filter: expected --kvp"),
        (["-o", "x.h5", "--detector", "film"], "--detector: expected --kvp"),
        (["-o", "x.h5", "--anode", "Xx"], "--anode: expected --kvp"),
        (["-o", "x.h5", "--spectrum", "s.txt", "--detector", "film"], "--detector beside it"),
        (["-o", "x.h5", "--spectrum", "s.txt", "--anode", "W"], "--spectrum: expected none of --kvp"),
        (["-o", "x.h5", "--energy", "60000"], "--energy: expected keV between"),
        (["-o", "x.h5", "--energy", "-4"], "--energy: expected a finite number > 0"),
        (["-o", "x.h5", "--kvp", "90", "--filter", "Al"], "--filter: expected a material and its thickness"),
        (["-o", "x.h5", "--kvp", "90", "--detector", "film"], "--detector: expected counting"),
        (["-o", "x.h5", "--kvp", "9000"], "kV"),
        (["-o", "x.h5", "--mono", "--energy", "60"], "--energy: expected a spectrum"),
        (["-o", "x.h5", "--set", "passes"], "--set: expected NAME=VALUE"),
        (["-o", "x.h5", "--unit", "mm"], "'cm', which the file states"),
        (["-o", "x.h5", "--centre", "3"], "centre: expected None"),
    ],
)
def test_bad_input_is_one_line_and_status_2(scan_file, solver, capsys, monkeypatch, options, message):
    monkeypatch.chdir(scan_file.parent)
    capsys.readouterr()
    assert main(["recon", "scan.h5", *options]) == 2
    errors = capsys.readouterr().err
    assert message in errors and errors.count("\n") == 1 and "Traceback" not in errors
    assert not solver, "the solver ran before the mistake was found"


def test_what_cannot_be_compared_with_the_truth_is_written_all_the_same(
    scan_file, tmp_path, solver, capsys, caplog
):
    """Of metal alone nothing is left that errors could be told of."""
    scan = load_scan(scan_file)
    save_scan(replace(scan, metal_mask=np.ones_like(scan.metal_mask)), tmp_path / "metal.h5")
    out, page, slices, figures = (tmp_path / name for name in ("out.h5", "r.html", "slices", "out.json"))
    options = ["-o", out, "--report", page, "--tiff", slices, "--json", figures]
    assert main(["recon", *map(str, [tmp_path / "metal.h5", *options])]) == 0
    assert all(path.exists() for path in (out, page, slices))
    assert json.loads(figures.read_text())["errors"] is None
    assert "Not compared with the truth" in caplog.text


@pytest.mark.parametrize("options, told", [([], True), (["--filter", "Al:0.1"], False)])
def test_a_tube_without_a_filter_is_told(scan_file, tmp_path, solver, caplog, options, told):
    assert main(["recon", str(scan_file), "-o", str(tmp_path / "x.h5"), "--kvp", "90", *options]) == 0
    assert ("--filter 'Al 1mm'" in caplog.text) == told


def test_a_missing_or_damaged_scan_is_status_2(tmp_path, capsys):
    (tmp_path / "junk.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    for name, message in (("none.h5", "existing file"), ("junk.h5", "readable HDF5")):
        assert main(["check", str(tmp_path / name)]) == 2
        assert message in capsys.readouterr().err


def test_debug_shows_where(tmp_path):
    with pytest.raises(FileNotFoundError):
        main(["check", "--debug", str(tmp_path / "none.h5")])


def test_interruption_and_failures_of_ours_have_their_own_status(
    scan_file, tmp_path, solver, monkeypatch, capsys
):
    command = ["recon", str(scan_file), "-o", str(tmp_path / "x.h5")]
    for error, status in ((KeyboardInterrupt(), 130), (RuntimeError("kernel\nbroke"), 1)):

        def fail(*_, error=error, **__):
            raise error

        monkeypatch.setitem(vars(tomo_polysplat), "reconstruct", fail)
        capsys.readouterr()
        assert main(command) == status
        assert capsys.readouterr().err.count("\n") == 1
        assert not (tmp_path / "x.h5").exists()


@pytest.mark.parametrize("command", ["demo", "recon", "simulate", "check", "bench", "doctor"])
def test_every_command_has_help(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0 and len(capsys.readouterr().out) > 100


def test_demo_prints_the_table_it_is_given(tmp_path, monkeypatch, capsys):
    entry = {"name": "polysplat", "seconds": 1.0, "psnr": 30.0, "psnr_all": 40.0, "ssim": 0.9, "rmse": 0.01}
    module = ModuleType("tomo_polysplat.bench.demo")
    module.run_demo = lambda folder, **options: {"methods": [entry]}
    module.FILES = ("demo.png", "demo.h5", "demo.json")
    monkeypatch.setitem(sys.modules, "tomo_polysplat.bench.demo", module)
    assert main(["demo", "-o", str(tmp_path / "new")]) == 0
    printed = capsys.readouterr().out
    assert "30.0" in printed and "demo.png" in printed
    (tmp_path / "new" / "demo.h5").write_text("precious")
    assert main(["demo", "-o", str(tmp_path / "new")]) == 2 and "--overwrite" in capsys.readouterr().err
    assert main(["demo", "-o", str(tmp_path / "new"), "--overwrite"]) == 0


def test_doctor_reports_versions_and_kernels(capsys):
    assert main(["doctor", "--no-test"]) == 0
    printed = capsys.readouterr().out
    for part in ("numpy", np.__version__, "astra-toolbox", "reference (cpu)", "free memory"):
        assert part in printed


def test_doctor_compiles_for_every_kind_of_scan(monkeypatch, capsys):
    from tomo_polysplat import doctor

    asked, seconds = set(), iter((1.5, 7.5))

    def reconstruct(scan, *, settings, progress):
        shape = scan.proj_geom["type"].split("_")[0], len(scan.projections) == 1
        asked.add((shape, scan.metal_mask.any(), scan.spectrum is not None, settings["pixel_rays"]))

    monkeypatch.setattr(doctor.tomo_polysplat, "reconstruct", reconstruct)
    monkeypatch.setattr("tomo_polysplat.kernels.compile_time.compiled_seconds", lambda: next(seconds))
    assert main(["doctor", "--no-test", "--warm"]) == 0
    assert "6.0 s of compiling" in capsys.readouterr().out
    ways = {(True, True, 2), (True, True, 1), (False, True, 1), (False, False, 1)}
    shapes = ("cone", False), ("parallel3d", False), ("cone", True)
    assert asked == {(shape, *way) for shape in shapes for way in ways}


def test_doctor_knows_the_wrong_dxchange(monkeypatch):
    from tomo_polysplat import doctor

    monkeypatch.setattr(doctor, "find_spec", lambda name: object())
    stranger, real = ModuleType("dxchange"), ModuleType("dxchange")
    real.read_aps_tomoscan_hdf5 = lambda: None
    monkeypatch.setitem(sys.modules, "dxchange", stranger)
    assert "unrelated" in doctor._dxchange() and "conda-forge" in doctor._dxchange()
    monkeypatch.setitem(sys.modules, "dxchange", real)
    assert "unrelated" not in doctor._dxchange()


def record_of(message, level=logging.WARNING, **extra):
    return logging.makeLogRecord(
        {"name": "test", "msg": message, "levelno": level, "levelname": "WARNING"} | extra
    )


def test_a_warning_is_shown_once_and_lines_are_its_own_alone():
    """Start volumes are made several times in a run, and each says what is wrong with the scan."""
    first = _FirstTime()
    shown = [first.filter(record_of(text)) for text in ("a", "a", "b", "a")]
    assert shown == [True, False, True, False]
    assert all(first.filter(record_of("a", logging.INFO)) for _ in range(2))
    formatter = _VisibleFormatter(("--sod", "--angles"))
    assert formatter.format(record_of("of a file\nERROR: forged")) == "WARNING: of a file ERROR: forged"
    assert (
        formatter.format(record_of("ours\n  - \x1b[31m", has_own_lines=True))
        == "WARNING: ours\n  - \\x1b[31m"
    )
    hint = record_of(
        "give source_object=, arc= or roll= or white=, not filter='Al 1mm'",
        name="tomo_polysplat.scan.readers.rtk",
    )
    assert formatter.format(hint) == "WARNING: give --sod, --angles or roll= or white=, not filter='Al 1mm'"
