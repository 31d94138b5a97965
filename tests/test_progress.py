"""The time left is that of the run as it goes, and bars neither hide in notebooks nor break lines of the log."""

import logging
import sys

import pytest
from small_scans import QUICK, fan, reconstruct

import tomo_polysplat as tps
from tomo_polysplat.progress import TimeLeft, progress_reports
from tomo_polysplat.scan import counts
from tomo_polysplat.simulate.folders.scene import marked_scan
from tomo_polysplat.simulate.folders.write import write_folder


def seconds(told):
    number, unit = told.removeprefix("at most ").split()[:2]
    return float(number) * {"s": 1, "min": 60, "h": 3600}[unit]


def estimates(steps):
    """(seconds that are left in truth, seconds told) of reports at (share, time)."""
    left, end = TimeLeft(), steps[-1][1]
    told = [(end - now, left.told(share, now)) for share, now in steps]
    return [(true, seconds(words)) for true, words in told if words]


def test_a_slow_beginning_is_no_part_of_the_estimate():
    """Sixty seconds of start and compiling, then a per cent a second: no six minutes that jump to one."""
    steps = [(0.0, 0.0), (0.0, 20.0), *((0.01 * k, 60.0 + k) for k in range(1, 101))]
    found = estimates(steps)
    assert len(found) > 90
    for true, told in found:
        assert told == pytest.approx(true, rel=0.15, abs=3), "as told as the truth rounds"


def test_a_run_that_slows_down_is_followed():
    quick = [(0.01 * k, 1.0 * k) for k in range(1, 51)]
    slow = [(0.5 + 0.01 * k, 50.0 + 4.0 * k) for k in range(1, 51)]
    late = [pair for pair in estimates(quick + slow) if 4 < pair[0] < 150]
    for true, told in late:
        assert told == pytest.approx(true, rel=0.25, abs=20)


def test_a_long_run_of_many_reports_is_told_from_its_first_pass():
    """An hour of ten passes, with a report every half second: known to 15 % after a third of the first pass."""
    steps = [(k / 7200, 0.5 * k) for k in range(1, 7201)]
    found = estimates(steps)
    assert found[0][0] > 0.96 * 3600
    for true, told in found:
        assert told == pytest.approx(true, rel=0.15, abs=30)


def test_a_fit_that_begins_anew_is_estimated_anew():
    left = TimeLeft()
    for k in range(1, 20):
        before = left.told(0.02 * k, float(k))
    assert before == "at most 30 s left"
    assert left.told(0.0, 25.0) == "" and left.told(0.02, 40.0) == "", "nothing is known yet"
    left.told(0.04, 50.0)
    assert left.told(0.06, 60.0) == "at most 8 min left"
    assert left.told(1.0, 70.0) == ""


def test_a_bar_is_drawn_where_it_is_wanted(capsys):
    with progress_reports(None) as report:
        report(0.5, "half")
    assert capsys.readouterr().err == "", "no terminal here"
    with progress_reports(True) as report:
        report(0.0, "calibration")
        report(0.5, "half")
    said = capsys.readouterr().err
    assert "calibration" in said and "50%" in said and "half" in said


def test_a_notebook_shows_it_unasked(monkeypatch):
    """Its streams are no terminals, which would leave the bar out."""
    import tqdm.auto
    import tqdm.notebook

    drawn = []

    class Bar(tqdm.notebook.tqdm_notebook):
        def __init__(self, **options):
            drawn.append(options)

        disable = True
        n, __enter__, __exit__ = 0.0, lambda self: self, lambda *_: None
        set_postfix_str = update = refresh = lambda *_, **__: None

    monkeypatch.setattr(tqdm.auto, "tqdm", Bar)
    with progress_reports(None) as report:
        report(0.5, "half")
    with progress_reports(False):
        pass
    assert [options["disable"] for options in drawn] == [False]


def test_lines_of_the_log_stay_whole(capsys):
    handler, root = logging.StreamHandler(sys.stderr), logging.getLogger()
    handler.setFormatter(logging.Formatter("%(levelname)s: %(message)s"))
    root.addHandler(handler)
    try:
        with progress_reports(True) as report:
            report(0.5, "half")
            logging.warning("a view is dark")
            report(0.6, "more")
    finally:
        root.removeHandler(handler)
    lines = capsys.readouterr().err.replace("\r", "\n").split("\n")
    assert [line for line in lines if "dark" in line] == ["WARNING: a view is dark"]


@pytest.mark.parametrize("kind", ["tiffs", "nxtomo", "h5"])
def test_reading_is_shown_while_it_goes_on(kind, tmp_path, monkeypatch, capsys):
    """Some views at a time; what is read at once has no bar."""
    path = tmp_path / "scan"
    scan = write_folder(kind if kind != "h5" else "tiffs", path, marked_scan(6, 9, 9))
    if kind == "h5":
        tps.save_scan(scan, path := tmp_path / "scan.h5")
    for blocks, shares in ((None, [1.0]), (2, [1 / 3, 2 / 3, 1.0])):
        if blocks is not None:
            monkeypatch.setattr(counts, "_BLOCK", blocks * 9 * 9)
        told = []
        tps.load_scan(path, progress=lambda share, words, told=told: told.append((share, words)))
        assert [share for share, _ in told] == pytest.approx(shares)
        assert {words for _, words in told} == {"reading"}
        monkeypatch.setattr("tomo_polysplat.progress._is_terminal", lambda _: True)
        capsys.readouterr()
        tps.load_scan(path)
        assert ("reading" in capsys.readouterr().err) == (blocks is not None)


def test_a_pass_is_shown_while_it_is_made(monkeypatch):
    """The first one has no error to tell yet; shares only grow, and there are more reports than passes."""
    monkeypatch.setattr("tomo_polysplat.fit.stopping._TICK", 0.0)
    told = []
    reconstruct(fan(), progress=lambda share, words: told.append((share, words)), settings=QUICK)
    first = [share for share, words in told if words == "first pass"]
    steps = -(-fan().views // QUICK["views_per_step"])
    assert len(first) == steps and first == sorted(first) and 0 < first[0] < first[-1] <= 0.5
    shares = [share for share, words in told if "error" in words]
    assert len(shares) > 2 and shares == sorted(shares)
