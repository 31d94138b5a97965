"""What is said about memory, and when a run is refused or its projections stay on the host."""

import numpy as np
import pytest
import torch

from tomo_polysplat.fit import memory

CPU, GPU = torch.device("cpu"), torch.device("cuda", 0)
SCENE = {
    "gaussians": 300_000,
    "views": 4,
    "pixels": 384**2,
    "voxels": 256**3,
    "projections": 360 * 384**2 * 4,
}


def with_free(monkeypatch, size):
    monkeypatch.setattr(memory, "free_bytes", lambda device: int(size))


def test_projections_stay_where_the_start_has_room_for_its_copies(monkeypatch):
    with_free(monkeypatch, 10e9)
    assert memory.projections_stay(2_000_000_000, GPU)
    assert not memory.projections_stay(3_000_000_000, GPU)
    assert memory.projections_stay(10**15, CPU)


def test_too_little_memory_is_refused_with_a_remedy(monkeypatch):
    with_free(monkeypatch, 1e9)
    with pytest.raises(ValueError, match="max_gaussians") as problem:
        memory.require_room(GPU, **SCENE)
    assert "1.00 GB" in str(problem.value)


def test_more_of_anything_needs_more(monkeypatch):
    """Just enough for a scene is too little for one with more Gaussians, views, pixels or voxels."""
    enough = None
    for size in np.geomspace(1e8, 1e11, 200):
        with_free(monkeypatch, size)
        try:
            memory.require_room(GPU, **SCENE)
        except ValueError:
            continue
        enough = size
        break
    assert enough is not None
    for name in ("gaussians", "views", "pixels", "voxels"):
        with pytest.raises(ValueError, match="GPU"):
            memory.require_room(GPU, **(SCENE | {name: SCENE[name] * 20}))


def test_room_for_gaussians_is_what_would_not_be_refused(monkeypatch):
    with_free(monkeypatch, 5e9)
    all_else = {name: SCENE[name] for name in ("views", "pixels", "voxels")}
    most = memory.room_for_gaussians(GPU, **all_else)
    memory.require_room(GPU, **(SCENE | {"gaussians": int(most)}))
    with pytest.raises(ValueError, match="GPU"):
        memory.require_room(GPU, **(SCENE | {"gaussians": int(most) + 1}))
    assert memory.room_for_gaussians(GPU, **(all_else | {"voxels": 4096**3})) == 0.0
    assert memory.room_for_gaussians(GPU, **(all_else | {"voxels": 512**3})) > 0.5 * most
    monkeypatch.setattr(memory, "available_memory", lambda: int(5e9))
    # A CPU holds the footprints of all views of a step, a GPU those of a few.
    assert 0 < memory.room_for_gaussians(CPU, **all_else) < most
    monkeypatch.setattr(memory, "available_memory", lambda: None)
    assert memory.room_for_gaussians(CPU, **all_else) == np.inf


def test_counts_beyond_32_bits_are_counted(monkeypatch):
    with_free(monkeypatch, 1e13)
    said = memory.require_room(GPU, **(SCENE | {"voxels": 4096**3, "projections": 2**33}))
    assert f"{(4096**3 * 12 + (12 << 25)) / 1e9:.2f} GB" in said and "on the GPU, 8.59 GB" in said
    assert "streamed" in memory.require_room(GPU, **(SCENE | {"projections": 0}))


@pytest.mark.gpu
def test_free_memory_is_what_an_allocation_takes():
    before = memory.free_bytes(GPU)
    held = torch.empty(1 << 28, dtype=torch.uint8, device="cuda")
    assert before - memory.free_bytes(GPU) == pytest.approx(1 << 28, rel=0.1)
    del held
    assert memory.free_bytes(GPU) == pytest.approx(before, rel=0.01)
