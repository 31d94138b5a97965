"""What every test folder shares: which devices there are, and GPU tests that cannot vanish unnoticed.

Torch is imported where it is used: the process that hands tests to others, which wait for it, needs none.
"""

from __future__ import annotations

import atexit
import gc
import math
import os
import pickle
import signal
from typing import TYPE_CHECKING
from unittest import mock

import pytest

if TYPE_CHECKING:
    import torch


def pytest_configure(config):
    if workers := getattr(config.option, "numprocesses", None):
        # Workers share the cores; threads of one would wait for those of the other. They are told before they begin:
        # numpy and torch read it when they are imported, and another package's plugin may import numpy first.
        os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // workers)))
        # Each process that a test starts would compile the package again, for 0.8 s.
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    # A background job of a shell inherits an ignored Ctrl-C, which tests of interruptions would wait for in vain.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if hasattr(config, "workerinput"):
        # One of several workers, which has told all by then. Python would look through all that is loaded once more,
        # for seconds, to free what ends with the process.
        atexit.register(os._exit, 0)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    from spread import LongestFirst

    return LongestFirst(config, log) if config.getvalue("dist") == "loadfile" else None


def pytest_collection_modifyitems(config, items):
    if hasattr(config, "workerinput"):  # one of several workers
        from spread import begin_with_the_longest

        begin_with_the_longest(items)


@pytest.hookimpl(wrapper=True)
def pytest_collection(session):
    # Nearly all that is imported stays: to look through it again and again takes a tenth of the time.
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


def pytest_collection_finish(session):
    # What is loaded by now stays. The garbage collector would look through all of it a hundred times, for 0.2 s each;
    # it finds nothing there, which took it 0.6 s in each worker.
    gc.freeze()
    # So does most of what tests load: to look through it as often as Python does took a fortieth of the time.
    gc.set_threshold(700, 10, 1000)


def pytest_unconfigure(config):
    if not hasattr(config, "workerinput"):  # a worker ends at once, see above
        gc.unfreeze()


def pytest_runtest_setup(item):
    if item.get_closest_marker("gpu") is None:
        return
    import torch

    if torch.cuda.is_available():
        return
    if os.environ.get("POLYSPLAT_REQUIRE_GPU") == "1":
        pytest.fail("POLYSPLAT_REQUIRE_GPU=1, but torch finds no CUDA device", pytrace=False)
    pytest.skip("needs a CUDA device")


@pytest.fixture(scope="module", autouse=True)
def spectra_are_not_doubted(request):
    """No run makes a second start, of one energy, to compare its spectrum with, but where a module asks for that.

    A spectrum that is not doubted changes nothing in a run, which tests of other things need not show again.
    """
    if getattr(request.module, "SPECTRA_ARE_DOUBTED", False):
        yield
        return
    from tomo_polysplat.plan import one_energy

    with mock.patch.object(one_energy, "_by_seeds", lambda *_: math.inf):
        yield


@pytest.fixture(scope="session", autouse=True)
def truths_are_made_once():
    """A phantom on a grid is made once for all scans of it; `simulate.truth` itself is asked in its own tests."""
    from tomo_polysplat.simulate import scenes

    make, made = scenes.voxelise_truth, {}

    def once(*of, **options):
        key = pickle.dumps((of, options))
        if key not in made:
            made[key] = make(*of, **options)
        return tuple(array.copy() for array in made[key])

    with mock.patch.object(scenes, "voxelise_truth", once):
        yield


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """Fail a test that leaves torch with other threads: the tests after it took up to six times as long."""
    import torch

    before = torch.get_num_threads()
    result = yield
    if (left := torch.get_num_threads()) != before:
        torch.set_num_threads(before)
        pytest.fail(f"torch had {before} threads before this test and {left} after it", pytrace=False)
    return result


@pytest.fixture(scope="session")
def devices() -> list[torch.device]:
    """Every device of this machine, CPU first."""
    import torch

    return [torch.device("cpu"), *(torch.device("cuda", k) for k in range(torch.cuda.device_count()))]


@pytest.fixture
def scan_file(tmp_path):
    """A file with a scan that takes a fraction of a second to reconstruct."""
    from small_scans import fan

    from tomo_polysplat.scan.io import save_scan

    path = tmp_path / "scan.npz"
    save_scan(fan(), path)
    return path
