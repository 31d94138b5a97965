"""The benchmark of sizes: its figures on volumes whose errors are known, and a record that can be read."""

import json

import numpy as np
import pytest

from tomo_polysplat.bench.scale import ScaleBench, structure_errors
from tomo_polysplat.cli import main
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.settings import PRESETS


def scan_of(truth, metal=None):
    """A scan that nobody reconstructs."""
    n = truth.shape[0]
    geometry = {"type": "parallel3d"}
    volume = {"GridSliceCount": n, "GridRowCount": n, "GridColCount": n}
    return Scan(np.zeros((1, 1, 1)), geometry, volume, truth=truth, metal_mask=metal)


def test_figures_of_volumes_that_are_known():
    rng = np.random.default_rng(0)
    truth = np.where(rng.random((24, 24, 24)) < 0.4, 2.0, 1.0).astype(np.float32)
    perfect = structure_errors(truth, scan_of(truth), (1.0, 2.0))
    assert perfect["dice"] == 1 and perfect["contrast"] == 1 and perfect["noise"] == 0
    assert perfect["dice_near_metal"] is None
    flat = structure_errors(1.5 + 0.6 * (truth - 1.5), scan_of(truth), (1.0, 2.0))
    assert flat["dice"] == 1 and flat["contrast"] == pytest.approx(0.6)
    noisy = structure_errors(truth + 0.1 * rng.standard_normal(truth.shape), scan_of(truth), (1.0, 2.0))
    assert noisy["noise"] == pytest.approx(0.1, rel=0.05) and noisy["contrast"] == pytest.approx(1, abs=0.01)
    assert structure_errors(np.ones_like(truth), scan_of(truth), (1.0, 2.0))["dice"] == 0


def test_near_metal_is_where_it_is():
    truth = np.ones((32, 32, 32), np.float32)
    truth[:, :, ::2] = 2.0
    metal = np.zeros(truth.shape, bool)
    metal[:, 2, 2] = True
    volume = truth.copy()
    volume[:, :8, :8] = 1.0  # lost beside metal
    found = structure_errors(volume, scan_of(truth, metal), (1.0, 2.0))
    assert found["dice_near_metal"] < 0.8 < found["dice"] < 1 and found["contrast"] == 1


def test_air_inside_of_a_foam_is_its_matrix_and_air_around_it_is_not():
    truth = np.zeros((20, 20, 20), np.float32)
    truth[4:16, 4:16, 4:16] = 1.0
    truth[8:12, 8:12, 8:12] = 0.0
    volume = truth + np.where(truth == 0, 0.25, 0.0)
    volume[:4] = 9.0
    assert structure_errors(volume, scan_of(truth), (0.0, 1.0))["contrast"] == pytest.approx(0.75)


def test_what_is_unknown_is_refused():
    for wrong in ({"kinds": ("cheese",)}, {"methods": ("magic",)}, {"seeds": 0}, {"sizes": (4,)}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            ScaleBench(**wrong)


def test_the_command_leaves_a_record(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(
        PRESETS, "balanced", {"passes": 1.0, "views_per_step": 8, "tv_factor": 1.0, "edges": "blurred"}
    )
    options = ["--sizes", "24", "--kinds", "bone", "--feature", "4", "--views", "24", "--metal", "both"]
    options += ["--methods", "fdk-water", "polysplat", "--record", str(tmp_path), "--device", "cpu"]
    assert main(["bench", "scale", *options]) == 0
    record = json.loads((tmp_path / "scale.json").read_text())
    assert [(run["method"], run["metal"]) for run in record["runs"]] == [
        ("fdk-water", True), ("polysplat", True), ("fdk-water", False), ("polysplat", False)
    ]  # fmt: skip
    assert all(0.3 < run["dice"] <= 1 and run["contrast"] > 0.2 for run in record["runs"])
    assert "bone 24, no metal" in (tmp_path / "scale.md").read_text()
    assert "near metal" in capsys.readouterr().out
    assert (tmp_path / "scale.png").stat().st_size > 1000
