"""How the recording of a graph ends where it fails; the GPU is a fake."""

import threading
from contextlib import nullcontext

import pytest
import torch

from tomo_polysplat import free_memory

pytest.importorskip("triton")
POOL = (0, 7)


class Allocator:
    """Torch's, as far as recordings concern it: what it records into, and how many graphs use a pool."""

    def __init__(self):
        self.underway, self.used = [], 0

    def begin(self):
        self.underway.append(POOL)
        self.used += 1

    def end(self, _, pool):
        if pool not in self.underway:
            raise RuntimeError("not currently recording")
        self.underway.remove(pool)

    def release(self, *_):
        self.used -= 1
        assert self.used >= 0


@pytest.fixture
def allocator(monkeypatch):
    made = Allocator()
    monkeypatch.setattr(torch.cuda, "stream", lambda _: nullcontext())
    monkeypatch.setattr(torch.cuda, "synchronize", lambda *_: None)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch._C, "_cuda_endAllocateToPool", made.end, raising=False)
    monkeypatch.setattr(torch._C, "_cuda_releasePool", made.release, raising=False)
    return made


def graph_of(allocator, begins, ends):
    class Graph:
        def capture_begin(self, pool, capture_error_mode):
            allocator.begin()
            if not begins:
                raise RuntimeError("does not begin")

        def capture_end(self):
            if not ends:
                raise RuntimeError("was invalidated")
            allocator.end(0, POOL)
            self.ended = True

        def __del__(self):
            if getattr(self, "ended", False):
                allocator.release()

    return Graph


@pytest.mark.parametrize(
    ("begins", "makes", "ends"),
    [(False, True, True), (True, False, True), (True, True, False), (True, False, False)],
)
def test_the_allocator_goes_on_after_a_recording_that_fails(begins, makes, ends, allocator, monkeypatch):
    from tomo_polysplat.fit.graph_step import GraphStep

    monkeypatch.setattr(torch.cuda, "CUDAGraph", graph_of(allocator, begins, ends))
    step = object.__new__(GraphStep)
    step._pool = POOL

    def make():
        assert free_memory.recording.locked(), "nobody else gives memory back"
        if not makes:
            raise torch.cuda.OutOfMemoryError("full")

    try:
        step._captured(make, None)
    except RuntimeError as problem:
        # With its frames goes the graph.
        assert str(problem) in ("does not begin", "full", "was invalidated")
    else:
        raise AssertionError("recorded all the same")
    assert (allocator.underway, allocator.used) == ([], 0)
    assert not free_memory.recording.locked()


def test_memory_is_given_back_between_recordings_only(monkeypatch):
    given = threading.Event()
    monkeypatch.setattr(torch.cuda, "empty_cache", given.set)
    with free_memory.recording:
        other = threading.Thread(target=free_memory.give_back)
        other.start()
        assert not given.wait(0.05)
    other.join()
    assert given.is_set()
