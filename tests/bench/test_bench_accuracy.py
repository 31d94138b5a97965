"""The accuracy benchmark: figures that mean what they say, conditions that are all met, a page that stands alone."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from tomo_polysplat.bench import peers
from tomo_polysplat.bench.accuracy import AccuracyBench
from tomo_polysplat.bench.accuracy_measures import Regions, edge_width
from tomo_polysplat.bench.accuracy_stopping import stopping
from tomo_polysplat.bench.measure import measure
from tomo_polysplat.bench.methods import METHODS, Method
from tomo_polysplat.bench.runs import without_figures
from tomo_polysplat.bench.scenes import cached_scan
from tomo_polysplat.bench.tables import cell, grouped, markdown_table
from tomo_polysplat.bench.task import Options, Task
from tomo_polysplat.cli import main

SOFT, METAL = 0.25, 5.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("scans")


def ball(size=41, radius=6.3, samples=3):
    """An antialiased ball of metal in the middle of soft matter, with its mask."""
    fine = (np.arange(size * samples) + 0.5) / samples - size / 2
    z, y, x = np.meshgrid(fine, fine, fine, indexing="ij", sparse=True)
    inside = (x**2 + y**2 + z**2 < radius**2).reshape(*[n for _ in range(3) for n in (size, samples)])
    share = inside.mean(axis=(1, 3, 5))
    return (SOFT + (METAL - SOFT) * share).astype(np.float32), share > 0


def test_regions_are_read_off_the_truth():
    truth, metal = ball()
    truth[:, :, :4] = 0.4  # a smaller plateau of other soft matter
    regions = Regions.of(truth, metal)
    assert regions.soft_value == pytest.approx(SOFT, rel=1e-3)
    assert (truth[regions.soft] == SOFT).all() and not regions.soft[:, :, :5].any()
    assert (truth[regions.core] == METAL).all() and 0 < regions.core.sum() < (truth == METAL).sum()
    assert regions.around[metal].all() and regions.around.sum() > 1.5 * metal.sum()


def test_signed_distance_to_a_ball():
    truth, metal = ball(radius=6.3)
    distance = Regions.of(truth, metal).distance
    z, y, x = np.indices(truth.shape) - 20
    exact = np.sqrt(x**2 + y**2 + z**2) - 6.3
    near = np.abs(exact) < 5
    assert np.abs(distance - exact)[near].max() < 1.0
    assert abs(float((distance - exact)[near].mean())) < 0.2


def test_biases_are_percent_of_the_truth():
    truth, metal = ball()
    regions = Regions.of(truth, metal)
    volume = np.where(metal, 0.9 * truth, 1.03 * truth)
    errors = regions.errors(volume, truth)
    assert errors["soft_bias"] == pytest.approx(3.0, abs=1e-3)
    assert errors["metal_bias"] == pytest.approx(-10.0, abs=1e-3)
    # Mass that is only smeared out is still there.
    smeared = regions.errors(gaussian_filter(truth, 0.5), truth)
    assert smeared["metal_bias"] is not None and abs(smeared["metal_mass"]) < 1.0


def test_nothing_is_made_up_where_there_is_nothing():
    flat = np.zeros((9, 9, 9), np.float32)
    errors = Regions.of(flat, None).errors(flat, flat)
    assert set(errors.values()) == {None}


@pytest.mark.parametrize("sigma", [1.0, 1.5, 2.0])
def test_width_of_a_blurred_edge(sigma):
    """A step blurred by a Gaussian falls from 90 to 10 % within 2 sqrt(2) erfinv(0.8) = 2.563 deviations."""
    step = np.zeros((5, 5, 60), np.float32)
    step[:, :, :30] = 1.0
    distance = np.broadcast_to(np.arange(60) - 29.5, step.shape)
    blurred = gaussian_filter(step, (0, 0, sigma))
    assert edge_width(step, distance) == pytest.approx(0.8, abs=1e-6)
    # A range of 3 voxels inside holds all of the edge only where it is sharp enough.
    expected = 2.563 * math.hypot(sigma, 12**-0.5)
    assert edge_width(blurred, distance) == pytest.approx(expected, rel=0.25 if sigma == 2 else 0.12)


def test_an_edge_that_does_not_fall_has_no_width():
    truth, metal = ball()
    distance = Regions.of(truth, metal).distance
    assert edge_width(np.full_like(truth, 0.3), distance) is None
    assert edge_width(truth, np.full(truth.shape, np.inf)) is None
    assert edge_width(truth, distance) == pytest.approx(1.0, abs=0.6)


def history(held_out, psnr):
    return [
        {
            "seconds": float(k),
            "iteration": 10 * k,
            "loss": 1.0,
            "held_out": h,
            "psnr": p,
            "rmse": 10 ** (-p / 20),
        }
        for k, (h, p) in enumerate(zip(held_out, psnr), start=1)
    ]


def test_what_the_stopping_rule_misses():
    """Held out, in the mean of four passes: best after pass 3, then worse; the truth went on improving for one pass."""
    found = stopping(history([4, 3, 2, 4, 4, 3.9, 0], [20, 25, 30, 31.5, 29, 28, 40]), {"patience": 3})
    assert (found["stops_after"], found["keeps"], found["passes"]) == (6, 3, 7)
    assert found["best"] == 7 and found["missed_db"] == pytest.approx(10.0)
    patient = stopping(history([4, 3, 2, 4, 4, 3.9, 0], [20, 25, 30, 31.5, 29, 28, 40]), {"patience": 4})
    assert (patient["stops_after"], patient["keeps"], patient["missed_db"]) == (7, 7, 0.0)
    assert stopping(history([5, 4, 3], [20, 25, 30]), {})["correlation"] == pytest.approx(1.0)
    assert stopping(history([None, None], [20, 25]), {})["correlation"] is None
    assert stopping(history([5], [20]), {}) is None


def test_every_combination_is_scanned_once_a_seed():
    bench = AccuracyBench(("pins",), (16, 24), ("fdk",), (30, 60), (80, 225), (1e4,), seeds=3)
    scans = [(*s.sizes, s.views, s.kvp, s.seed) for s in bench.scans()]
    assert len(scans) == len(set(scans)) == 24
    assert scans[:3] == [(16, 30, 80, seed) for seed in range(3)]
    for wrong in ({"seeds": 0}, {"methods": ("fkd",)}, {"scenes": ("pin",)}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            AccuracyBench(**wrong)


def test_tables_of_repeated_runs():
    runs = [{"a": 1, "x": 2.0}, {"a": 2, "x": None}, {"a": 1, "x": 4.0}]
    ones, twos = grouped(runs, ("a",))
    assert cell(ones, "x", "{:+.1f}") == "+3.0 ± 1.4" and cell(twos, "x", "{:.1f}") == "–"
    assert markdown_table(["a", "b"], [["1", "|"]]).splitlines() == [
        "| a | b |",
        "| --- | --- |",
        "| 1 | \\| |",
    ]


def test_a_peer_that_is_not_there_is_skipped(folder, monkeypatch):
    import sys

    task = Task.of(cached_scan("pins", 16, 44, folder=folder), "cpu")
    monkeypatch.setitem(sys.modules, "mbirtorch", None)
    for name in ("mbir", "mbir-mar", "mbir-metal"):
        run = measure(METHODS[name], task, Options())
        assert run.seconds is None
        assert "pip install mbirtorch" in without_figures({"about": run.about})


def test_a_scan_in_the_peers_words(folder):
    """A point of the volume, projected by its documentation's formulas, hits the pixel of our geometry."""
    task = Task.of(cached_scan("pins", 16, 44, folder=folder), "cpu")
    centred = task.geometry
    geometry = replace(centred, corner=centred.corner + 0.7 * centred.u - 1.3 * centred.v)
    angles, reverse, told = peers.cone_parameters(replace(task, geometry=geometry))
    point = np.array([0.31, -0.17, 0.23])
    for view in (0, 7, 29):
        source = geometry.origin[view]
        matrix = np.stack([geometry.u[view], geometry.v[view], geometry.corner[view] - source], axis=1)
        a, b, c = np.linalg.solve(matrix, point - source)
        column, row = (
            n if step > 0 else count - 1 - n
            for n, step, count in zip((a / c, b / c), reverse[::-1], (geometry.columns, geometry.rows))
        )
        sine, cosine = np.sin(angles[view]), np.cos(angles[view])
        across, away = point @ [cosine, -sine, 0], told["source_iso_dist"] - point @ [sine, cosine, 0]
        stretch = told["source_detector_dist"] / away
        channel = (across * stretch + told["det_channel_offset"]) / told["delta_det_channel"]
        line = (point[2] * stretch + told["det_row_offset"]) / told["delta_det_row"]
        assert channel + (geometry.columns - 1) / 2 == pytest.approx(column, abs=1e-6)
        assert line + (geometry.rows - 1) / 2 == pytest.approx(row, abs=1e-6)
    assert told["recon_shape"] == (16, 16, 16)


def test_a_scan_that_the_peer_cannot_take_is_skipped(folder):
    from tomo_polysplat.simulate.scenes import simulate_scan

    task = Task.of(simulate_scan("pins", 16, 20, geometry="parallel"), "cpu")
    with pytest.raises(peers.Skipped, match="circular cone"):
        peers.cone_parameters(task)


def test_command_line(folder, tmp_path, capsys, monkeypatch):
    def broken(task, options):
        raise MemoryError("no room")

    monkeypatch.setitem(METHODS, "sirt", Method("SIRT", broken))
    options = "--scenes pins --sizes 9 --views 20 --photons 1e4 --seeds 2 --methods fdk sirt polysplat"
    options = [*options.split(), "--device", "cpu", "--passes", "2"]
    target = tmp_path / "records"
    command = ["bench", "accuracy", *options, "--cache", str(folder), "--record", str(target)]
    assert main(command) == 1  # something failed
    record = json.loads((target / "accuracy.json").read_text())
    good = [run for run in record["runs"] if run["seconds"] is not None]
    assert len(record["runs"]) == 6 and len(good) == 4
    assert {run["seed"] for run in good} == {0, 1} and all(run["cpu_seconds"] > 0 for run in good)
    assert good[0]["rmse"] != good[2]["rmse"]  # other noise
    assert [len(curve["history"]) for curve in record["curves"]] == [2]
    assert all(kept["passes"] == 2 and kept["missed_db"] >= 0 for kept in record["stopping"])
    page = (target / "accuracy.html").read_text()
    # Three pictures of one condition, all inside; nothing is fetched.
    assert page.count("data:image/png;base64") == 3 and "http" not in page
    table = (target / "accuracy.md").read_text()
    assert "±" in table and "failed: MemoryError: no room" in table and "no room" in capsys.readouterr().out
