"""The kernel benchmark counts the pairs there are, and gives no speed to a kernel that is wrong."""

import json
import subprocess

import pytest

from tomo_polysplat.bench import environment as environment_module
from tomo_polysplat.bench import kernels
from tomo_polysplat.bench.environment import environment
from tomo_polysplat.bench.kernels import Case, as_text, bench_kernels
from tomo_polysplat.kernels.project import reference

SMALL = Case(gaussians=300, size=0.05, pixels=63, views=2)


def test_pairs_are_the_pixels_within_three_deviations():
    """Counted one by one: the reference's image of a Gaussian is zero beyond the cut."""
    case = Case(gaussians=8, size=0.12, pixels=256, views=2)
    views, scene = kernels._views(case), kernels._scene(case, 8, 1)
    counted = 0
    for n in range(8):
        image, skipped = reference.project(
            *(t[n : n + 1].double() for t in scene[:3]), scene[3][:, n : n + 1].double(), views, 3.0
        )
        assert skipped == 0
        counted += int((image > 0).sum())
    # The ellipse is that of |e|^2 at its centre; a whole footprint sees it vary by some per cent either way.
    assert kernels._pairs(scene, views) == pytest.approx(counted, rel=0.02)


def test_records_and_table():
    records = bench_kernels("cpu", cases=[SMALL], repeats=2)
    record = json.loads(json.dumps(records))[0]
    assert record["kernel"] == "numba"
    assert record["correct"]
    assert record["image_error"] < 1e-5
    for name in ("forward", "backward"):
        assert record[f"{name}_seconds"] > 0
        assert record[f"{name}_pairs_per_second"] == pytest.approx(
            record["pairs"] / record[f"{name}_seconds"]
        )
    assert record["compile_seconds"] >= 0
    table = as_text(records)
    assert "numba on cpu" in table
    assert f"{record['forward_pairs_per_second']:.2e}" in table


def test_a_wrong_kernel_has_no_speed(monkeypatch):
    right = kernels.autograd.project

    def one_per_cent_off(*args, kernel, **kwargs):
        image, skipped = right(*args, kernel=kernel, **kwargs)
        return (image if kernel == "reference" else 1.01 * image), skipped

    monkeypatch.setattr(kernels.autograd, "project", one_per_cent_off)
    records = bench_kernels("cpu", cases=[SMALL], repeats=1)
    assert not records[0]["correct"]
    assert records[0]["image_error"] == pytest.approx(0.01, rel=0.1)
    assert records[0]["forward_pairs_per_second"] is None
    assert "WRONG by 1e-02" in " ".join(as_text(records).split())


def test_unknown_kernel():
    with pytest.raises(ValueError, match="kernel"):
        bench_kernels("cpu", kernel="opencl")


@pytest.mark.gpu
def test_on_a_gpu():
    records = bench_kernels("cuda", cases=[SMALL], repeats=2)
    assert records[0]["correct"]
    assert records[0]["kernel"] == "triton"


def test_environment_says_what_a_time_depends_on():
    found = json.loads(json.dumps(environment()))
    assert found["cpu"]
    assert found["threads"] >= 1
    assert found["versions"]["torch"]


def test_no_commit_outside_a_checkout(monkeypatch):
    def not_a_repository(command, **kwargs):
        raise subprocess.CalledProcessError(128, command)

    monkeypatch.setattr(environment_module.subprocess, "run", not_a_repository)
    assert environment()["commit"] is None
