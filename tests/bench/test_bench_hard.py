"""The hard cases in short, and that none of them can pass by looking at nothing, crashing or hanging."""

import json

import numpy as np
import pytest
from watched_cases import bad, crashing, good, hanging, noisy

from tomo_polysplat.bench import hard
from tomo_polysplat.bench.hard import HARD_CASES, chosen_cases, run_hard_bench
from tomo_polysplat.bench.hard_cases.case import Case, Findings, refused
from tomo_polysplat.bench.hard_cases.same import relative_rms, same_volume
from tomo_polysplat.bench.hard_process import Worker, run_here
from tomo_polysplat.bench.hard_report import as_markdown, as_text
from tomo_polysplat.checks import fail
from tomo_polysplat.cli import main
from tomo_polysplat.settings import PRESETS

SPECTRA_ARE_DOUBTED = True  # see tests/conftest.py

# One or two of every kind, the quick ones.
SHORT = (
    *("starved-20", "nan", "saturated", "all-dead", "two-views", "truncated", "source-near", "source-inside"),
    *(
        "one-voxel",
        "offset-1000",
        "float16",
        "memory-mapped",
        "empty",
        "metal-one-voxel",
        "one-energy",
        "two-metals",
    ),
    *("gaussian-alone", "gaussians-ordinary", "needles", "behind-the-source", "densities", "material-ends"),
)


@pytest.mark.parametrize("name", SHORT)
def test_case(name, monkeypatch):
    # A step of one view or two, as the plan would have it, takes as long as one of eight. What a voxel weighs is wrong
    # by a tenth after half of the steps.
    monkeypatch.setitem(PRESETS, "balanced", {"views_per_step": 4 if name.endswith("one-voxel") else 8})
    outcome = run_here(HARD_CASES[name], "cpu")
    assert outcome.passed, (outcome.error, outcome.findings)


@pytest.mark.gpu
@pytest.mark.parametrize("name", SHORT)
def test_case_on_a_gpu(name):
    outcome = run_here(HARD_CASES[name], "cuda")
    assert outcome.passed, (outcome.error, outcome.findings)


def test_every_case_has_a_name_of_its_own_and_a_reason():
    cases = [case for module in hard._MODULES for case in module.CASES]
    assert len(cases) == len(HARD_CASES) > 60
    assert all(len(case.why.split()) >= 4 for case in cases)


def test_cases_are_chosen_by_name_in_the_order_of_the_table():
    assert [case.name for case in chosen_cases(["needles", "nan"])] == ["nan", "needles"]
    with pytest.raises(ValueError, match="only: .*'nine'"):
        chosen_cases(["nine"])


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_a_number_is_no_success(value):
    findings = Findings()
    findings.at_most("error", value, 1.0)
    assert not findings.passed and json.loads(json.dumps(findings.entries))[0]["got"] == str(value)
    findings = Findings()
    findings.at_least("error", -value, 1.0)
    assert not findings.passed


def test_one_failure_fails_and_nothing_is_no_success():
    findings = Findings()
    assert not findings.passed
    findings.at_least("PSNR", 31.0, 30.0)
    assert findings.passed
    findings.equal("rays", 3, 4)
    assert not findings.passed


def test_a_refusal_names_the_argument_and_comes_first():
    def at_once(progress):
        raise fail("source", "one", "none")

    def too_late(progress):
        progress(0.0, "start volume")
        raise fail("source", "one", "none")

    assert refused(at_once, ValueError, "source").passed
    for function, error, words in (
        (too_late, ValueError, "source"),
        (at_once, TypeError, "source"),
        (at_once, ValueError, "sink"),
        (lambda progress: None, ValueError, "source"),
    ):
        assert not refused(function, error, words).passed


@pytest.mark.parametrize(
    "device, off, same", [("cpu", 1e-6, False), ("cuda", 1e-6, True), ("cuda", 0.1, False)]
)
def test_the_same_volume_is_the_same_bits_on_a_cpu(device, off, same):
    volume, findings = np.ones((2, 3, 4)), Findings()
    assert relative_rms(volume * (1 + off), volume) == pytest.approx(off, rel=1e-3)
    same_volume(findings, volume * (1 + off), volume, device, "volume")
    assert findings.passed == same


def test_what_is_raised_or_warned_of_is_the_outcome():
    outcome = run_here(Case("noisy", "", noisy), "cpu")
    assert not outcome.passed and "RuntimeWarning" in outcome.error
    assert run_here(Case("good", "", good), "cpu").passed


def test_a_crash_and_a_hang_are_failures_of_their_own(monkeypatch):
    cases = [
        Case(f.__name__, "a reason of its own", f, limit=2.0) for f in (good, crashing, bad, hanging, good)
    ]
    seen = []
    record = run_hard_bench("cpu", cases, update=lambda so_far: seen.append(len(so_far["cases"])))
    record = json.loads(json.dumps(record))
    assert [case["passed"] for case in record["cases"]] == [True, False, False, False, True]
    assert "code 11" in record["cases"][1]["error"] and "hung" in record["cases"][3]["error"]
    assert seen == [1, 2, 3, 4, 5]
    text, page = as_text(record), as_markdown(record)
    assert "2 of 5 cases passed on cpu" in text and "failed: crashing, bad, hanging" in text
    assert "1.5 FAILED" in text and "error <= 1" in text
    lines = page.splitlines()
    assert [line.split(" | ")[0] for line in lines[2:7]] == [f"| {case.name}" for case in cases]


def test_a_worker_that_was_not_needed_ends_quietly():
    with Worker("cpu"):
        pass


def test_command_line(tmp_path, capsys, monkeypatch):
    options = ["bench", "hard", "--device", "cpu", "--record", str(tmp_path)]
    assert main([*options, "--only", "gaussian-alone"]) == 0
    assert "1 of 1 cases passed" in capsys.readouterr().out
    record = json.loads((tmp_path / "hard.json").read_text())
    assert record["cases"][0]["passed"] and record["environment"]["versions"]["torch"]
    assert (tmp_path / "hard.md").read_text().startswith("| case |")
    assert main([*options, "--only", "gaussian-alne"]) == 2
    failed = record | {"cases": [record["cases"][0] | {"passed": False}]}
    monkeypatch.setattr(hard, "run_hard_bench", lambda *a, **k: failed)
    assert main([*options, "--only", "gaussian-alone"]) == 1
