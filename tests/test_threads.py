"""Solves in threads and processes side by side, and what a solve leaves behind: nothing."""

import hashlib
import logging
import multiprocessing
import os
import random
import signal
import sys
import threading
import warnings
from contextlib import nullcontext
from functools import cache

import numba
import numpy as np
import pytest
import torch
from small_scans import ASKED, QUICK, cone, fan, reconstruct

from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.kernels import device

# A child that hangs is a failure, not a night's wait.
SECONDS = 120


def digest(seed=0):
    """The volume of a solve, to the last bit."""
    return hashlib.sha256(reconstruct(fan(), seed=seed).volume.tobytes()).hexdigest()


@cache
def alone(seed=0):
    """That of this process, which no child asks for: a fork would inherit the answer."""
    return digest(seed)


def pinned():
    """On one core of those there are, where the system lets a process choose."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def in_processes(method, seeds, begin=None):
    """Digests of solves in as many processes at once, each after a call of ``begin``."""
    with multiprocessing.get_context(method).Pool(len(seeds), begin) as pool:
        return pool.map_async(digest, seeds, chunksize=1).get(SECONDS)


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="this system cannot fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_forked_processes_side_by_side_give_what_one_gives_alone():
    expected, before = [alone(seed) for seed in (0, 1)], torch.get_num_threads()
    try:
        # Threads of torch and of the kernels have run in this process: a child has none of them.
        torch.set_num_threads(max(2, before))
        torch.ones(600, 600) @ torch.ones(600, 600)
        assert in_processes("fork", [0, 1]) == expected and expected[0] != expected[1]
    finally:
        torch.set_num_threads(before)


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="this system cannot fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_process_saves_and_explains_what_its_parent_has_made(tmp_path):
    """Outside of a solve, where torch has as many threads as it likes, which a child lacks."""
    scan = fan()
    result = reconstruct(scan)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        (torch.rand(1 << 21) > 0.5).sum()
        result.save(tmp_path / "a.nii.gz")
        child = multiprocessing.get_context("fork").Process(target=_use, args=(result, scan, tmp_path))
        child.start()
        child.join(SECONDS)
        child.kill()
        assert child.exitcode == 0
        assert (tmp_path / "a.nii.gz").read_bytes() == (tmp_path / "b.nii.gz").read_bytes()
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def _use(result, scan, folder):
    result.save(folder / "b.nii.gz")
    result.explain(scan)


def test_a_spawned_process_on_one_core_gives_the_same():
    assert in_processes("spawn", [0], pinned) == [alone()]


# From few views the start is made by SIRT, from more by filtered backprojection.
SCANS = {"few views": lambda: cone(12, 20), "metal": fan, "calibrated": lambda: fan(False)}


@pytest.mark.parametrize("name", SCANS)
def test_the_same_bits_for_any_number_of_threads(name, monkeypatch):
    def bits():
        options = {"align": "auto", "calibrate": None, "settings": QUICK | ASKED}
        if name == "calibrated":
            longer = {"passes": 4.0, "views_per_step": 10}
            options |= {"calibrate": "scatter", "settings": QUICK | ASKED | longer}
        result = reconstruct(SCANS[name](), **options)
        return hashlib.sha256(result.basis.tobytes() + result.gaussians["position"].tobytes()).hexdigest()

    before, found = (torch.get_num_threads(), numba.get_num_threads()), {}
    users = [module for module in list(sys.modules.values()) if hasattr(module, "cpu_threads")]
    assert len(users) > 3
    try:
        for threads in (1, 2, 5):
            for module in users:
                monkeypatch.setattr(module, "cpu_threads", lambda threads=threads: threads)
            torch.set_num_threads(threads)
            numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
            found[threads] = bits()
    finally:
        torch.set_num_threads(before[0])
        numba.set_num_threads(before[1])
    assert len(set(found.values())) == 1, found


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_fork_within_a_solve_can_solve_itself():
    """As a callback may do; the parent's solve goes on."""
    answers = []

    def fork(state):
        if not answers:
            answers.extend(in_processes("fork", [0]))

    result = reconstruct(fan(), callbacks=[fork])
    assert answers == [alone()]
    assert hashlib.sha256(result.volume.tobytes()).hexdigest() == alone()


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_lock_held_while_forking_does_not_hang_the_child():
    expected = alone()
    with device._borrowed.lock:
        assert in_processes("fork", [0]) == [expected]


def surroundings():
    """Everything outside the package that a solve could leave changed."""
    return {
        "torch threads": torch.get_num_threads(),
        "numba threads": numba.get_num_threads(),
        "environment": dict(os.environ),
        "folder": os.getcwd(),
        "numpy random": str(np.random.get_state()),  # noqa: NPY002  # the global state is what is looked at
        "torch random": torch.random.get_rng_state().tolist(),
        "random": random.getstate(),
        "numpy errors": np.geterr(),
        "numpy print": str(np.get_printoptions()),
        "torch type": torch.get_default_dtype(),
        "torch gradients": torch.is_grad_enabled(),
        "torch determinism": torch.are_deterministic_algorithms_enabled(),
        "tf32": torch.get_float32_matmul_precision(),
        "signals": [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGFPE)],
        "log": (list(logging.root.handlers), logging.root.level),
        "warnings": list(warnings.filters),
        "threads": threading.active_count(),
    }


class Broken(Exception):
    """Raised in the middle of a stage."""


def broken(*_, **__):
    raise Broken


STAGES = {
    "none": None,
    "start volume": "tomo_polysplat.plan.preparation.first_volume",
    "fit": "tomo_polysplat.fit.scene.FitScene.projections",
    "volume": "tomo_polysplat.fit.scene.FitScene.basis",
}


@pytest.mark.parametrize("stage", STAGES)
def test_a_solve_leaves_nothing_behind(stage, monkeypatch):
    alone()  # what is imported and compiled once
    before = surroundings()
    with monkeypatch.context() as patched, nullcontext() if stage == "none" else pytest.raises(Broken):
        if stage != "none":
            patched.setattr(STAGES[stage], broken)
        reconstruct(fan())
    after = surroundings()
    assert {name for name in before if before[name] != after[name]} == set()


def test_a_solve_does_not_know_what_was_solved_before():
    first = alone()
    reconstruct(fan(False), seed=9)
    with pytest.raises(ValueError, match="settings"):
        reconstruct(fan(), settings={"nothing": 1})
    assert digest() == first


@pytest.mark.parametrize(
    "mode",
    [
        torch.no_grad,
        torch.inference_mode,
        lambda: torch.autocast("cpu", dtype=torch.bfloat16),
        lambda: np.errstate(all="raise"),
        lambda: torch.device("meta"),
    ],
    ids=["no gradients", "inference", "autocast", "NumPy raises", "another device"],
)
def test_modes_of_the_caller_do_not_matter(mode):
    expected = alone()
    with mode():
        assert digest() == expected


def test_a_default_type_of_the_caller_does_not_matter():
    expected = alone()
    torch.set_default_dtype(torch.float64)
    try:
        assert digest() == expected
    finally:
        torch.set_default_dtype(torch.float32)


def test_the_caller_may_use_torch_in_a_thread_meanwhile():
    """A callback's thread keeps its own modes, and the solve its result."""
    expected, seen = alone(), []

    def other():
        with torch.no_grad():
            seen.append(torch.is_grad_enabled())
            seen.append(float((torch.ones(50, 50) @ torch.ones(50, 50)).sum()))

    def beside(state):
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()

    result = reconstruct(fan(), callbacks=[beside])
    assert seen[:2] == [False, 125_000.0]
    assert hashlib.sha256(result.volume.tobytes()).hexdigest() == expected


def test_torch_has_one_thread_for_the_volume_as_well(monkeypatch):
    seen, before, basis = [], torch.get_num_threads(), FitScene.basis
    monkeypatch.setattr(FitScene, "basis", lambda *a: (seen.append(torch.get_num_threads()), basis(*a))[1])
    torch.set_num_threads(2)
    try:
        reconstruct(fan())
        assert seen == [1] and torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
