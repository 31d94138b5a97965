"""The plan's benchmark: scans that need what they are named for, variants that differ, a record that can be read."""

import json

import numpy as np
import pytest

from tomo_polysplat.bench.ablation_variants import DEFAULT
from tomo_polysplat.bench.plan import SCANS, PlanBench, variants
from tomo_polysplat.bench.plan_report import as_markdown
from tomo_polysplat.cli import main
from tomo_polysplat.settings import PRESETS, make_settings


@pytest.mark.parametrize("name", SCANS)
def test_variants_change_the_settings_each_in_its_own_way(name):
    varied = [DEFAULT, *variants(SCANS[name], 3)]
    changed = [(v.one_energy, make_settings(changes=dict(v.settings))) for v in varied]
    assert changed[0] == (False, make_settings())
    assert all(one != other for k, one in enumerate(changed) for other in changed[:k])
    assert len({v.label for v in varied}) == len(changed)
    # The last two take every decision otherwise that is about the model.
    model = {"curves", "spectral_nodes", "support_level", "free_radius"}
    everything, finer = (variant.settings for variant in varied[-2:])
    assert (
        model <= everything.keys()
        and everything["views_per_step"] == 3
        and finer == everything | {"seed_spacing": 1.0}
    )


def test_scans_are_what_their_names_say():
    scans = {name: SCANS[name].scan(8, 2, 0) for name in SCANS}
    assert [name for name, scan in scans.items() if scan.metal_mask.any()] == ["metal"]
    filled = {name: np.mean(scan.truth > 0.05 * scan.truth.max()) for name, scan in scans.items()}
    assert filled["small object"] < 0.1 < filled["no metal"]
    assert np.ptp(scans["narrow spectrum"].spectrum.energies) < 3 < np.ptp(scans["metal"].spectrum.energies)


def test_unknown_scans_are_refused():
    for wrong in ({"scans": ("no such",)}, {"size": 0}, {"again": -1}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            PlanBench(**wrong)


def test_the_command_leaves_a_record(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        "tomo_polysplat.bench.plan.variants", lambda scan, together: [variants(scan, together)[1]]
    )
    monkeypatch.setitem(PRESETS, "balanced", {"passes": 2.0, "views_per_step": 6})
    # All that beats the plan, or is a hundred decibels behind, is tried again.
    monkeypatch.setattr("tomo_polysplat.bench.plan._AHEAD", -100.0)
    chosen = ["--again", "2", "--scans", "narrow spectrum", "--size", "7", "--views", "12", "--device", "cpu"]
    assert main(["bench", "plan", *chosen, "--record", str(tmp_path)]) == 0
    record = json.loads((tmp_path / "plan.json").read_text())
    assert [run["method"] for run in record["runs"]] == ["default", "3 curves"]
    assert len(record["stopping"][0]["history"]) == record["stopping"][0]["rule"]["passes"] == 2
    again = [(run["seed"], run["method"]) for run in record["again"]]
    assert again == [(1, "default"), (1, "3 curves"), (2, "default"), (2, "3 curves")]
    gains = [
        one["psnr"] - plan["psnr"] for plan, one in (record["runs"], record["again"][:2], record["again"][2:])
    ]
    table = (tmp_path / "plan.md").read_text()
    assert f"| 3 curves | 3 | {np.mean(gains):+.2f} ({min(gains):+.2f} to {max(gains):+.2f}) |" in table
    assert table == as_markdown(record) and "the plan" in table and "| 3 curves |" in table
    assert table.strip() in capsys.readouterr().out
    assert (tmp_path / "plan-stopping.png").read_bytes()[1:4] == b"PNG"
