"""Compiling is taken off the clock that time budgets go by."""

import sys
import time
from types import SimpleNamespace

import numba
import pytest
import torch

from tomo_polysplat.kernels import compile_time
from tomo_polysplat.kernels.compile_time import compiled_seconds, track_compiling, working_time


@pytest.fixture(autouse=True)
def tracked():
    track_compiling()


def test_what_numba_compiles_counts_once_though_one_function_compiles_another():
    @numba.njit
    def inner(a):
        return a * 2 + 1

    @numba.njit
    def outer(a):
        return inner(a) + inner(a + 1)

    before, begun = compiled_seconds(), time.perf_counter()
    worked = working_time()
    outer(3.0)
    took, counted = time.perf_counter() - begun, compiled_seconds() - before
    assert 0.3 * took < counted <= took
    assert working_time() - worked == pytest.approx(took - counted, abs=0.02)
    before = compiled_seconds()
    outer(4.0)
    assert compiled_seconds() == before


def test_what_triton_compiles_counts_but_not_what_it_finds_on_disk():
    knobs = pytest.importorskip("triton.knobs")
    track_compiling()
    before = compiled_seconds()
    told = {"src": None, "metadata": {}, "metadata_group": {}, "times": SimpleNamespace(total=2_500_000)}
    knobs.compilation.listener(**told, cache_hit=True)
    assert compiled_seconds() == before
    knobs.compilation.listener(**told, cache_hit=False)
    assert compiled_seconds() == pytest.approx(before + 2.5)


def test_it_listens_once(monkeypatch):
    pytest.importorskip("triton.knobs")
    track_compiling()
    for name in ("_listen_to_numba", "_listen_to_triton"):
        monkeypatch.setattr(compile_time, name, lambda: pytest.fail("twice"))
    track_compiling()


@pytest.mark.parametrize("loaded, gpu", [(False, False), (True, False), (False, True)])
def test_triton_is_left_alone_where_nothing_would_use_it(monkeypatch, loaded, gpu):
    listened = []
    monkeypatch.setattr(compile_time, "_tracked_triton", False)
    monkeypatch.setattr(compile_time, "_listen_to_triton", lambda: listened.append(True))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    if loaded:
        monkeypatch.setitem(sys.modules, "triton", object())
    else:
        monkeypatch.delitem(sys.modules, "triton", raising=False)
    track_compiling()
    assert bool(listened) == (loaded or gpu)
