"""The benchmark of reconstructions: shared scans, clocks that stop, failures that show, records that can be read."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tomo_polysplat.bench import measure as measure_module
from tomo_polysplat.bench import runs as runs_module
from tomo_polysplat.bench import scenes
from tomo_polysplat.bench.measure import error_history, measure
from tomo_polysplat.bench.methods import METHODS, Method
from tomo_polysplat.bench.recon import ReconBench, run_recon_bench
from tomo_polysplat.bench.recon_report import as_text, write_figures
from tomo_polysplat.bench.runs import timed_runs, warm_up, with_errors
from tomo_polysplat.bench.scenes import cache_folder, cached_scan, fewer_views
from tomo_polysplat.bench.task import Options, Task
from tomo_polysplat.cli import main
from tomo_polysplat.fit.fork import FEWEST_PASSES
from tomo_polysplat.fit.optimise import FitState
from tomo_polysplat.fit.stopping import StopReason
from tomo_polysplat.result.metrics import compare

QUICK = {"passes": 1.0, "views_per_step": 4}
# "sirt-200" is "sirt", only longer; the rest belongs to packages that need not be here.
DIFFERENT = [name for name in METHODS if name != "sirt-200" and not name.startswith("mbir")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("scans")


@pytest.fixture(scope="module")
def task(folder):
    return Task.of(cached_scan("pins", 12, 44, folder=folder), "cpu")


def test_a_scan_is_simulated_once(folder, monkeypatch):
    first = cached_scan("pins", 16, 44, folder=folder)
    monkeypatch.setattr(scenes, "simulate_scan", lambda *a, **k: pytest.fail("simulated again"))
    again = cached_scan("pins", 16, 44, folder=folder)
    np.testing.assert_array_equal(first.projections, again.projections)
    np.testing.assert_array_equal(first.truth, again.truth)
    assert (again.name, again.spectrum) == ("pins", first.spectrum)
    for other in ({"photons": 2e5}, {"seed": 1}):
        with pytest.raises(pytest.fail.Exception, match="simulated again"):
            cached_scan("pins", 16, 44, folder=folder, **other)


def test_a_control_is_the_scene_without_its_metal(folder):
    metal, control = (cached_scan(name, 16, 44, folder=folder) for name in ("pins", "pins-control"))
    assert control.name == "pins-control" and not control.metal_mask.any()
    np.testing.assert_allclose(control.truth[~metal.metal_mask], metal.truth[~metal.metal_mask], rtol=1e-6)
    assert control.truth.max() < 0.1 * metal.truth.max()


def test_the_cache_is_private(tmp_path, monkeypatch):
    monkeypatch.setattr(scenes.tempfile, "gettempdir", lambda: str(tmp_path))
    made = cache_folder()
    assert made == cache_folder() and made.parent == tmp_path
    assert made.stat().st_mode & 0o077 == 0


@pytest.mark.parametrize(("device", "asked"), [("cuda:0", True), ("cpu", False)])
def test_a_warm_up_on_a_gpu_does_all_that_a_whole_run_does(task, device, asked, monkeypatch):
    """Ours has to be long enough for its pixels to be asked about; a CPU compiles nothing for that."""
    made = []

    def note(method, task, options):
        made.append((method.label, options.settings["passes"]))
        return SimpleNamespace(seconds=1.0)

    monkeypatch.setattr(runs_module, "measure", note)
    chosen = {name: METHODS[name] for name in ("fdk", "polysplat")}
    warm_up(chosen, replace(task, device=device), {}, lambda words: None)
    ours = METHODS["polysplat"].label
    assert made.count((METHODS["fdk"].label, 1.0)) == made.count((ours, 1.0)) == 2
    assert len(made) == 4 + asked and ((ours, FEWEST_PASSES) in made) == asked


def test_fewer_views_are_views_of_the_same_scan(task):
    few = fewer_views(task.scan, 20)
    assert few.views == 22
    np.testing.assert_array_equal(few.projections, task.scan.projections[:, ::2])
    np.testing.assert_array_equal(Task.of(few, "cpu").geometry.origin, task.geometry.origin[::2])
    assert fewer_views(task.scan, 100).views == 44


def test_rays_without_light_are_left_out(task):
    scan = fewer_views(task.scan, 20)
    scan.valid = np.ones(scan.projections.shape, bool)
    scan.valid[3, 4, 5] = False
    missing = np.argwhere(np.isnan(Task.of(scan, "cpu").projections))
    assert missing.tolist() == [[4, 3, 5]]


@pytest.mark.parametrize("name", DIFFERENT)
def test_every_method_runs(name, task):
    run = measure(METHODS[name], task, Options(None, QUICK))
    assert run.volume is not None, run.about
    assert run.volume.shape == task.scan.truth.shape
    assert run.seconds > 0 and run.peak_memory > 1e7


def test_a_failure_is_a_result(task):
    def broken(task, options):
        raise MemoryError("no room")

    def wrong(task, options):
        return np.full(task.grid.shape, np.nan), {}

    for function, words in ((broken, "MemoryError: no room"), (wrong, "not finite")):
        run = measure(Method("x", function), task, Options())
        assert run.seconds is None and run.volume is None
        assert words in run.about["error"]


def test_errors_are_followed_outside_of_the_clock(task, monkeypatch):
    """A method of 2 s a pass, watched by somebody who takes 5 s each time."""
    clock = SimpleNamespace(now=100.0, perf_counter=lambda: clock.now)

    def steady(task, options):
        for number in range(1, 6):
            clock.now += 2.0
            volume = task.scan.truth + np.float32(0.1 / number)
            state = FitState(clock.now - 100.0, number, 0, 1.0, 1.0, 0.0, lambda v=volume: v)
            if any([callback(state) for callback in options.callbacks]):
                break
        return volume, {}

    errors_of = measure_module._errors

    def slow(*arguments):
        clock.now += 5.0
        return errors_of(*arguments)

    monkeypatch.setattr(measure_module, "time", clock)
    monkeypatch.setattr(measure_module, "_errors", slow)
    method = Method("steady", steady, improves=True)
    history = error_history(method, task, {}, None)
    assert [point["seconds"] for point in history] == [2.0, 4.0, 6.0, 8.0, 10.0]
    expected = compare(task.scan.truth + np.float32(0.02), task.scan.truth, task.scan.metal_mask)
    assert history[-1]["psnr"] == pytest.approx(expected["psnr"], abs=1e-3)
    assert history[-1]["psnr_all"] == pytest.approx(expected["psnr_all"], abs=1e-3)
    assert history[-1]["rmse"] == pytest.approx(expected["rmse"], rel=1e-3)
    clock.now = 100.0
    assert [point["seconds"] for point in error_history(method, task, {}, 3.0)] == [2.0, 4.0]


def test_a_budget_that_was_not_used_up_is_not_enlarged(task, monkeypatch):
    asked = []

    def run(method, task, options):
        asked.append(options.time_budget)
        return measure_module.Run(task.scan.truth, min(options.time_budget or 0.1, 2.0), 1, {})

    monkeypatch.setattr(runs_module, "measure", run)
    methods = {name: METHODS[name] for name in ("fdk", "polysplat")}
    entries = with_errors(timed_runs(methods, task, (30, 1, 10), {}, lambda words: None), task.scan)
    assert asked == [None, 1, 10]
    assert [entry["budget"] for entry in entries] == asked
    assert entries[0]["rmse"] == 0


def test_a_budget_that_ended_a_run_is_enlarged_however_early_that_was(task, monkeypatch):
    """What a run says counts for more than how long it took."""
    reasons = {1: StopReason.BUDGET, 3: StopReason.PASSES}

    def run(method, task, options):
        budget = options.time_budget
        return measure_module.Run(
            task.scan.truth, 0.8 * budget, 1, {"stop": {"value": reasons[budget].value}}
        )

    monkeypatch.setattr(runs_module, "measure", run)
    runs = timed_runs({"polysplat": METHODS["polysplat"]}, task, (1, 3, 9), {}, lambda words: None)
    assert [named["budget"] for named, _ in runs] == [1, 3]


def test_unknown_names_are_refused():
    for wrong, words in (
        ({"methods": ["fkd"]}, "methods"),
        ({"scenes": ["pin"]}, "scenes"),
        ({"budgets": [0]}, "budgets"),
    ):
        with pytest.raises(ValueError, match=words):
            ReconBench(**wrong)


def test_record_table_and_figures(folder, tmp_path):
    methods = ("fdk", "polysplat")
    bench = ReconBench(("pins",), (11, 12), methods, views=20, settings=QUICK)
    seen = []
    record = run_recon_bench(bench, cache=folder, update=lambda r: seen.append(len(r["runs"])))
    assert seen == [2, 4]
    record = json.loads(json.dumps(record))
    assert [(e["size"], e["method"]) for e in record["warm_up"]] == [
        (n, m) for n in (11, 12) for m in methods
    ]
    assert all(e["cold_seconds"] > 0 and e["warm_seconds"] > 0 for e in record["warm_up"])
    scan = bench.scan("pins", 12, folder)
    fdk = next(r for r in record["runs"] if (r["size"], r["method"]) == (12, "fdk"))
    volume = measure(METHODS["fdk"], Task.of(scan, "cpu"), Options()).volume
    assert fdk["psnr"] == pytest.approx(compare(volume, scan.truth, scan.metal_mask)["psnr"])
    assert [(c["size"], c["method"]) for c in record["curves"]] == [(11, "polysplat"), (12, "polysplat")]
    assert all(len(c["history"]) == 1 for c in record["curves"])
    record["runs"][1] |= {"seconds": None, "about": {"error": "out of luck"}}
    table = as_text(record)
    assert f"{fdk['psnr']:.2f}" in table and "failed: out of luck" in table
    written = write_figures(tmp_path, record)
    assert [path.name for path in written] == [
        "recon-error-pins-11.png",
        "recon-error-pins-12.png",
        "recon-seconds-pins.png",
    ]
    assert all(path.stat().st_size > 5000 for path in written)


def test_command_line(folder, tmp_path, capsys):
    options = ["--scenes", "pins", "--sizes", "16", "--views", "44", "--methods", "fdk", "--device", "cpu"]
    target = tmp_path / "records"
    assert main(["bench", "recon", *options, "--cache", str(folder), "--record", str(target)]) == 0
    assert "fdk" in capsys.readouterr().out
    record = json.loads((target / "recon.json").read_text())
    assert record["bench"]["photons"] == 1e5 and record["environment"]["versions"]["torch"]
    assert record["runs"][0]["psnr"] > 0
    assert (target / "recon-error-pins-16.png").exists()


def test_command_line_of_kernels(tmp_path, capsys, monkeypatch):
    from tomo_polysplat.bench import kernels

    small = kernels.Case(gaussians=200, size=0.05, pixels=33, views=2)
    monkeypatch.setitem(kernels.CASES, "cpu", (small,))
    assert main(["bench", "kernels", "--device", "cpu", "--repeats", "1", "--record", str(tmp_path)]) == 0
    assert "numba on cpu" in capsys.readouterr().out
    assert json.loads((tmp_path / "kernels.json").read_text())["kernels"][0]["correct"]


@pytest.mark.gpu
@pytest.mark.parametrize("name", DIFFERENT)
def test_every_method_runs_on_a_gpu(name, folder):
    scan = cached_scan("pins", 48, 90, folder=folder)
    run = measure(METHODS[name], Task.of(scan, "cuda"), Options(None, {"passes": 2.0}))
    assert run.volume is not None, run.about
    assert compare(run.volume, scan.truth, scan.metal_mask)["psnr_all"] > 25
