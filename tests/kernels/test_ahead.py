"""A helper that compiles the CPU kernels ends in time, costs nothing where it fails, and compiles what fits use."""

import subprocess
import sys
import time

import numpy as np
import pytest
import torch

from tomo_polysplat.kernels import ahead, compile_time, select
from tomo_polysplat.kernels.ahead import compile_voxelise, compiled_ahead, wait_for_kernels
from tomo_polysplat.kernels.project import numba_kernel as project_kernel
from tomo_polysplat.kernels.project.autograd import project
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.kernels.voxelise import numba_kernel as voxelise_kernel
from tomo_polysplat.kernels.voxelise.autograd import voxelise
from tomo_polysplat.kernels.voxelise.box import VoxelBox


@pytest.fixture
def cold(monkeypatch):
    """Two cores, nothing on disk, and a list of what this process compiles itself."""
    compiled = []
    monkeypatch.setattr(ahead, "cpu_threads", lambda: 2)
    monkeypatch.setattr(ahead, "_compiled_project", lambda: False)
    monkeypatch.setattr(ahead, "compile_voxelise", lambda: compiled.append("volume"))
    return compiled


def test_a_helper_ends_with_its_context(cold, monkeypatch):
    monkeypatch.setattr(ahead, "_START", "import time; time.sleep(60)")
    with compiled_ahead("cpu"):
        helper = ahead._helper
        assert helper.poll() is None
        with compiled_ahead("cpu"):
            assert ahead._helper is helper
    assert helper.returncode is not None and ahead._helper is None


def test_waiting_for_a_helper_counts_as_compiling(cold, monkeypatch):
    monkeypatch.setattr(ahead, "_START", "import time; time.sleep(0.5)")
    compile_time.track_compiling()
    with compiled_ahead("cpu"):
        before, begun = compile_time.compiled_seconds(), time.perf_counter()
        wait_for_kernels()
        took = time.perf_counter() - begun
        assert ahead._helper is None
    assert compile_time.compiled_seconds() - before == pytest.approx(took, abs=0.1)


@pytest.mark.parametrize("start", ["raise SystemExit(3)", "while True: pass"])
def test_a_helper_that_fails_or_hangs_is_done_without(cold, monkeypatch, start):
    monkeypatch.setattr(ahead, "_START", start)
    monkeypatch.setattr(ahead, "_LONGEST", 0.2)
    with compiled_ahead("cpu"):
        wait_for_kernels()
    assert cold == ["volume"]
    wait_for_kernels()
    assert cold == ["volume"]


def test_a_helper_that_is_at_the_last_part_is_left_to_it(cold, monkeypatch):
    monkeypatch.setattr(ahead, "_START", "pass")
    with compiled_ahead("cpu"):
        monkeypatch.setattr(ahead, "_compiled_project", lambda: True)
        wait_for_kernels()
    assert not cold


@pytest.mark.parametrize("name", ["cpu_threads", "_compiled_project", "executable"])
def test_none_is_started_in_vain(cold, monkeypatch, name):
    if name == "executable":
        monkeypatch.setattr(sys, name, "")
    else:
        monkeypatch.setattr(ahead, name, lambda: 1)
    with compiled_ahead("cpu"):
        assert ahead._helper is None


def test_a_device_that_is_none_is_told_of_by_the_reconstruction_alone(cold):
    with compiled_ahead("toaster"):
        assert ahead._helper is None


# What compiles is not loaded, as that takes seconds: what is called in its place tells what the helper asks for.
HELPER = """
import sys, time, types
from tomo_polysplat.kernels import ahead_helper

def compile_the_first(*_):
    print("begun", flush=True)
    time.sleep({seconds})

sys.modules["tomo_polysplat.kernels.select"] = types.SimpleNamespace(availability=compile_the_first)
ahead_helper.compile_voxelise = lambda: print("volume")
ahead_helper.main()
"""


@pytest.mark.parametrize("word, seconds, code", [(ahead.STOP, 0.5, 0), (b"", 60, 1)])
def test_the_helper_stops_when_told_and_ends_with_the_other_process(word, seconds, code):
    command = [sys.executable, "-c", HELPER.format(seconds=seconds)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as helper:
        assert helper.stdout.readline() == b"begun\n"
        helper.stdin.write(word)
        helper.stdin.flush()
        if not word:
            helper.stdin.close()
        assert helper.wait(20) == code
        assert helper.stdout.read() == b""


def signatures(*functions):
    return [list(function.signatures) for function in functions]


def test_a_fit_has_the_types_that_were_compiled_ahead():
    kernels = [voxelise_kernel.set_up, voxelise_kernel._fill, voxelise_kernel._gather_range]
    kernels += [project_kernel.set_up, project_kernel._splat, project_kernel._gather_range]
    select._self_check.__wrapped__("numba", "cpu")
    compile_voxelise()
    before = signatures(*kernels)
    assert all(before)
    generator = torch.Generator().manual_seed(0)
    scene = [
        torch.rand(shape, generator=generator).requires_grad_() for shape in ((7, 3), (7, 3), (7, 4), (2, 7))
    ]
    box = VoxelBox(np.zeros(3), np.full(3, 0.25), (5, 4, 3))
    voxelise(*scene, box, kernel="numba", cutoff=3.0).square().sum().backward()
    matrix = np.stack([np.eye(3)] * 2)
    views = DetectorViews(False, np.zeros((2, 3)), matrix, 4, 5).select([1, 0])
    image, _ = project(*scene, views, kernel="numba", cutoff=3.0)
    image.square().sum().backward()
    assert signatures(*kernels) == before


def test_what_was_compiled_from_another_source_is_not_there(monkeypatch):
    select._self_check.__wrapped__("numba", "cpu")
    assert ahead._compiled_project()
    monkeypatch.setattr(project_kernel._gather_range._cache._cache_file, "_source_stamp", "another")
    assert not ahead._compiled_project()
