"""What is said about memory, and when a run is refused or its projections stay on the host."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tomo_polysplat.fit import memory
from tomo_polysplat.fit.optimise import Course, fit
from tomo_polysplat.ranks import Ranks

sys.path.append(str(Path(__file__).parents[1] / "kernels"))
from step_scenes import fit_problem

CPU, GPU = torch.device("cpu"), torch.device("cuda", 0)
SCENE = memory.StepSize(gaussians=300_000, views=4, pixels=384**2, voxels=256**3)
PROJECTIONS = 360 * 384**2 * 4


def with_free(monkeypatch, size):
    monkeypatch.setattr(memory, "free_bytes", lambda device: int(size))


def test_projections_stay_where_the_start_has_room_for_its_copies(monkeypatch):
    with_free(monkeypatch, 10e9)
    assert memory.projections_stay(2_000_000_000, GPU)
    assert not memory.projections_stay(3_100_000_000, GPU)
    assert memory.projections_stay(10**15, CPU)


def test_too_little_memory_is_refused_with_a_remedy(monkeypatch):
    with_free(monkeypatch, 1e9)
    with pytest.raises(ValueError, match="max_gaussians") as problem:
        memory.require_room(GPU, SCENE, PROJECTIONS)
    assert "1.00 GB" in str(problem.value)


def test_more_of_anything_needs_more(monkeypatch):
    """Just enough for a scene is too little for one with more Gaussians, views, pixels or voxels."""
    enough = None
    for size in np.geomspace(1e8, 1e11, 200):
        with_free(monkeypatch, size)
        try:
            memory.require_room(GPU, SCENE, PROJECTIONS)
        except ValueError:
            continue
        enough = size
        break
    assert enough is not None
    for name in ("gaussians", "views", "pixels", "voxels"):
        with pytest.raises(ValueError, match="GPU"):
            memory.require_room(GPU, replace(SCENE, **{name: getattr(SCENE, name) * 20}), PROJECTIONS)


def test_room_for_gaussians_is_what_would_not_be_refused(monkeypatch):
    with_free(monkeypatch, 5e9)
    most = memory.room_for_gaussians(GPU, SCENE)
    memory.require_room(GPU, replace(SCENE, gaussians=int(most)), PROJECTIONS)
    with pytest.raises(ValueError, match="GPU"):
        memory.require_room(GPU, replace(SCENE, gaussians=int(most) + 1), PROJECTIONS)
    assert memory.room_for_gaussians(GPU, replace(SCENE, voxels=4096**3)) == 0.0
    # As many bytes fewer as the voxels take more.
    fewer = 13 * (512**3 - SCENE.voxels) / memory._GAUSSIAN
    assert memory.room_for_gaussians(GPU, replace(SCENE, voxels=512**3)) == pytest.approx(most - fewer)
    monkeypatch.setattr(memory, "available_memory", lambda: int(5e9))
    # A CPU holds the footprints of all Gaussians, a GPU those of a portion.
    assert 0 < memory.room_for_gaussians(CPU, SCENE) < most
    monkeypatch.setattr(memory, "available_memory", lambda: None)
    assert memory.room_for_gaussians(CPU, SCENE) == np.inf


def test_counts_beyond_32_bits_are_counted(monkeypatch):
    with_free(monkeypatch, 1e13)
    said = memory.require_room(GPU, replace(SCENE, voxels=4096**3), 2**33)
    assert f"{(4096**3 * 13 + (12 << 25)) / 1e9:.2f} GB" in said and "on the GPU, 8.59 GB" in said
    assert "streamed" in memory.require_room(GPU, SCENE, 0)


def test_a_step_takes_what_was_measured_on_a_gpu():
    """On an H100: 2.77 GB while a step is made and tried for the first time, besides the Gaussians themselves."""
    count, voxels = 9_576_542, 400**3
    taken = 2.77e9 + 56 * count
    told = memory.step_bytes(GPU, memory.StepSize(count, views=6, pixels=600**2, voxels=voxels))
    counted = sum(told.values()) - min(memory._SAMPLES, 27 * 12 * voxels)
    assert taken <= counted < 1.5 * taken


def test_a_larger_cloud_never_takes_less(monkeypatch):
    """Also where it begins to be drawn by portions; two runs of it take twice as much."""
    scene = {"views": 12, "pixels": 0, "voxels": 0}

    def taken(count, runs=1):
        return sum(memory.step_bytes(GPU, memory.StepSize(count, runs=runs, **scene)).values())

    counts = [100_000, 600_000, 999_999, 1_000_001, 1_500_000, 3_000_000]
    one = [taken(count) for count in counts]
    assert sorted(one) == one and [taken(count, 2) for count in counts] == [2 * size for size in one]


def test_ranks_part_what_gaussians_take(monkeypatch):
    """But not what the first one has of all of them, nor the portion that is drawn at a time."""
    scene = {"views": 12, "pixels": 0, "voxels": 0}
    counts = [100_000, 300_000, 20_000_000, 50_000_000]
    taken = {}
    for ranks in (1, 2, 8):
        monkeypatch.setattr(memory, "current_ranks", lambda ranks=ranks: Ranks(0, ranks))
        sizes = [memory.StepSize(count, **scene) for count in counts]
        taken[ranks] = [sum(memory.step_bytes(GPU, size).values()) for size in sizes]
        assert sorted(taken[ranks]) == taken[ranks]
    assert all(0.5 * one < two < 1.4 * one for one, two in zip(taken[1], taken[2]))
    assert all(1 / 8 * one < eight < one and eight < two for one, two, eight in zip(*taken.values()))


def test_a_gpu_that_is_full_all_the_same_is_told_with_a_remedy(monkeypatch):
    """Whatever a run has begun with."""
    problem = fit_problem("cone", True, "cpu", "numba")

    def full(*_, **__):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")

    monkeypatch.setattr("tomo_polysplat.fit.fitter.make_step", full)
    course = Course(views_per_step=2, rng=np.random.default_rng(0), started=0.0, volume=lambda _: None)
    with pytest.raises(MemoryError, match="2.00 GiB.*max_gaussians.*settings=.*memory"):
        fit(problem, course)


def test_what_recorded_graphs_keep_is_no_room_for_a_volume(monkeypatch):
    """Torch keeps 8 GB, of which it can give back what is no graph's: 1 GB, or all."""
    for free in (1.5e9, 8.5e9):
        state = [5e8]
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _, state=state: (int(state[0]), int(1e10)))
        monkeypatch.setattr(memory, "give_back", lambda free=free, state=state: state.insert(0, free))
        with_free(monkeypatch, 5e8 + 8e9)
        assert memory.voxels_at_once(GPU) == int(0.45 * free / memory._MADE)


@pytest.mark.gpu
def test_free_memory_is_what_an_allocation_takes():
    before = memory.free_bytes(GPU)
    held = torch.empty(1 << 28, dtype=torch.uint8, device="cuda")
    assert before - memory.free_bytes(GPU) == pytest.approx(1 << 28, rel=0.1)
    del held
    assert memory.free_bytes(GPU) == pytest.approx(before, rel=0.01)
