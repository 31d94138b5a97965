"""The ablation: variants that differ in what they say, the affine projection, records that can be read."""

import json
from unittest import mock

import numpy as np
import pytest
import torch

from tomo_polysplat.bench import ablation_affine
from tomo_polysplat.bench.ablation import AblationBench
from tomo_polysplat.bench.ablation_affine import project_affine
from tomo_polysplat.bench.ablation_variants import DEFAULT, GROUPS
from tomo_polysplat.bench.measure import measure
from tomo_polysplat.bench.scenes import cached_scan
from tomo_polysplat.bench.task import Options, Task
from tomo_polysplat.cli import main
from tomo_polysplat.kernels.project.reference import project
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.settings import make_settings

PASS = Options(None, {"passes": 1.0, "views_per_step": 4})
ALL = [variant for variants in GROUPS.values() for variant in variants]


@pytest.fixture(scope="module")
def task(tmp_path_factory):
    return Task.of(cached_scan("pins", 15, 44, folder=tmp_path_factory.mktemp("scans")), "cpu")


@pytest.fixture(scope="module")
def default_volume(task):
    return measure(DEFAULT.method(), task, PASS).volume


@pytest.fixture(scope="module")
def errors():
    """Of fewer Gaussians and pixels than the benchmark's."""
    with mock.patch.multiple(ablation_affine, _GAUSSIANS=60, _PIXELS=48):
        return ablation_affine.affine_errors()


def test_variants_differ_from_the_default_and_from_each_other():
    assert len({variant.label for variant in [DEFAULT, *ALL]}) == 1 + len(ALL)
    plain = make_settings().to_dict()
    for variant in ALL:
        changed = make_settings(changes=dict(variant.settings)).to_dict() != plain
        assert changed or variant.samples or variant.materials or variant.one_energy, variant.label


def test_the_straight_line_is_one():
    """(1-u)^2 soft + 2u(1-u) middle + u^2 dense of its materials is (1-u) water + u iron at every energy."""
    energies = np.linspace(20, 90, 15)
    straight = GROUPS["curve"][0].materials
    curves, ends = (Materials.of(m).mass_attenuation(energies) for m in (straight, None))
    for u in (0.0, 0.16, 0.5, 0.9):
        mixed = np.array([(1 - u) ** 2, 2 * u * (1 - u), u**2]) @ curves
        np.testing.assert_allclose(mixed, (1 - u) * ends[0] + u * ends[2], rtol=1e-6)


@pytest.mark.parametrize("variant", [GROUPS["components"][0], GROUPS["nodes"][0], GROUPS["curve"][1]])
def test_variants_run_and_change_the_volume(variant, task, default_volume):
    changed = measure(variant.method(), task, PASS)
    assert changed.volume is not None, changed.about
    assert np.abs(changed.volume - default_volume).max() > 1e-3 * default_volume.max()


def test_samples_of_the_spectrum_are_the_nodes(task):
    run = measure(GROUPS["nodes"][1].method(), task, Options(None, {"passes": 0.1}))
    assert run.about["plan"]["spectrum"]["value"] == 15


def view(distance, half=1.5, pixels=33):
    """A view from far or near of a square about the origin, that much magnified."""
    step = 2 * half / pixels
    edge = -half + step / 2
    matrix = np.array([[step, 0.0, edge], [0.0, 0.0, distance], [0.0, step, edge]])
    return DetectorViews(True, np.array([[0.0, -distance, 0.0]]), matrix[None], pixels, pixels)


def cloud(width):
    rng = np.random.default_rng(3)
    parts = (rng.uniform(-0.5, 0.5, (20, 3)), width * rng.uniform(0.5, 2, (20, 3)))
    return [torch.from_numpy(p) for p in (*parts, rng.normal(size=(20, 4)), rng.uniform(0.5, 1.5, 20))]


def error(width, distance):
    position, scale, rotation, weight = cloud(width)
    exact = project(position, scale, rotation, weight[None], view(distance), 8.0)[0][0]
    approximate = project_affine(position, scale, rotation, weight, view(distance))
    return float((approximate - exact).abs().max() / exact.max())


def test_the_affine_projection_is_exact_for_rays_that_are_parallel():
    near, far, farther = (error(0.1, distance) for distance in (4.0, 4e3, 4e4))
    assert far < 0.02 * near and farther < 1e-4
    # The error is of first order in the angle that a Gaussian is wide.
    assert far / farther == pytest.approx(10, rel=0.2)


def test_affine_errors_grow_with_the_cone_and_with_the_gaussians(errors):
    table = {(e["half_angle_degrees"], e["width"]): e["rms_percent"] for e in errors}
    angles, widths = (sorted({key[place] for key in table}) for place in (0, 1))
    for width in widths:
        assert np.all(np.diff([table[angle, width] for angle in angles]) > 0)
    for angle in angles:
        assert np.all(np.diff([table[angle, width] for width in widths]) > 0)


def test_unknown_groups_are_refused():
    for wrong in ({"groups": ("node",)}, {"seeds": 0}, {"scenes": ("pin",)}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            AblationBench(**wrong)


def test_command_line(tmp_path, capsys, errors, monkeypatch):
    monkeypatch.setattr("tomo_polysplat.bench.ablation.affine_errors", lambda *_: errors)
    options = ["--scenes", "pins", "--size", "15", "--views", "20", "--groups", "relocation", "affine"]
    options += ["--device", "cpu", "--passes", "1", "--seeds", "2", "--cache", str(tmp_path)]
    assert main(["bench", "ablation", *options, "--record", str(tmp_path)]) == 0
    assert "no relocation" in capsys.readouterr().out
    record = json.loads((tmp_path / "ablation.json").read_text())
    labels = [(run["method"], run["seed"]) for run in record["runs"]]
    assert labels == [(name, seed) for seed in (0, 1) for name in ("default", "no relocation")]
    assert all(run["psnr"] > 0 and run["cpu_seconds"] > 0 for run in record["runs"])
    table = (tmp_path / "ablation.md").read_text()
    assert "relocation: pins" in table and "±" in table and "half angle" in table
