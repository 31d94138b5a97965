"""Work shared out over threads, and arrays copied by all of them."""

import threading
import time
from contextlib import nullcontext

import numpy as np
import pytest

from tomo_polysplat import parallel
from tomo_polysplat.parallel import contiguous, kept_threads, run_tasks


def test_a_copy_in_another_order_and_type_is_numpys():
    array = np.random.default_rng(0).normal(size=(5, 7, 11))[:, ::-1]
    for view in (array.swapaxes(0, 1), array[0], array[:0]):
        copy = contiguous(view, np.float32)
        assert copy.flags.c_contiguous and copy.dtype == np.float32
        assert np.array_equal(copy, view.astype(np.float32))


def test_what_is_in_order_is_not_copied():
    array = np.zeros((3, 4), np.float32)
    assert contiguous(array, np.float32) is array


def test_what_the_type_cannot_hold_is_infinite_without_a_warning(recwarn):
    assert np.isinf(contiguous(np.full((4, 3), 1e300), np.float32)).all() and not recwarn


def test_results_come_in_the_order_of_the_tasks():
    with kept_threads():
        for count in (0, 1, 2, 7, 100):
            assert run_tasks(lambda a, b: a * b, [(k, 3) for k in range(count)]) == [
                3 * k for k in range(count)
            ]


@pytest.mark.parametrize("keep", [kept_threads, nullcontext])
def test_tasks_may_have_tasks_of_their_own(keep, monkeypatch):
    """More at once than there are threads to run them: none waits for one that never begins."""
    monkeypatch.setattr(parallel, "cpu_threads", lambda: 3)

    def inner(k):
        return sum(run_tasks(lambda m: k * m, [(m,) for m in range(5)]))

    with keep():
        assert run_tasks(inner, [(k,) for k in range(20)]) == [10 * k for k in range(20)]


@pytest.mark.parametrize("keep", [kept_threads, nullcontext])
@pytest.mark.parametrize("error", [IndexError, KeyboardInterrupt])
def test_an_exception_ends_the_work(keep, error, monkeypatch):
    monkeypatch.setattr(parallel, "cpu_threads", lambda: 2)
    done, before = [], threading.active_count()

    def task(k):
        if k == 3:
            raise error("the third")
        done.append(k)
        time.sleep(0.001)

    with keep(), pytest.raises(error, match="the third"):
        run_tasks(task, [(k,) for k in range(1000)])
    assert len(done) < 1000 and threading.active_count() == before


def test_kept_threads_end_with_their_keeper(monkeypatch):
    monkeypatch.setattr(parallel, "cpu_threads", lambda: 3)
    together, before = threading.Barrier(3, timeout=30), threading.active_count()
    with kept_threads():
        for _ in range(5):
            run_tasks(together.wait, [()] * 3)
        assert threading.active_count() == before + 2
    assert threading.active_count() == before
