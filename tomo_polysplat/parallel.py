"""Work shared out over CPU threads.

The compiled CPU kernels release the interpreter lock, so plain threads run them side by side. Unlike a
compiler's own thread pool this may be used from several threads at once and after a fork.
"""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

__all__ = [
    "contiguous",
    "copy_array",
    "cpu_threads",
    "kept_threads",
    "of_parts",
    "run_tasks",
    "shares",
    "split_range",
]

# Bytes of a task, so that to copy them, or to look at them, takes longer than to hand them to a thread.
_COPIED_AT_ONCE, _LOOKED_AT_AT_ONCE = 1 << 21, 1 << 22
# The process that keeps threads, and its threads.
_kept: ContextVar[tuple[int, ThreadPoolExecutor] | None] = ContextVar("_kept", default=None)


def _without_torch_threads() -> None:
    """Let torch work alone in a forked process: it would wait for ever for the threads that only the parent has."""
    if alone := getattr(sys.modules.get("torch"), "set_num_threads", None):
        alone(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_without_torch_threads)


def cpu_threads() -> int:
    """Threads this process may use: its CPU affinity, or ``OMP_NUM_THREADS`` where that is smaller."""
    affinity = getattr(os, "sched_getaffinity", None)
    available = len(affinity(0)) if affinity else (os.cpu_count() or 1)
    requested = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, min(available, int(requested))) if requested.isdigit() else available


def split_range(length: int, parts: int) -> list[tuple[int, int]]:
    """Cut ``range(length)`` into at most ``parts`` contiguous, non-empty ``(start, stop)`` pieces."""
    parts = max(1, min(parts, length))
    bounds = [length * k // parts for k in range(parts + 1)]
    return [(a, b) for a, b in zip(bounds[:-1], bounds[1:]) if b > a]


def shares(length: int, each: int, threads: int) -> list[tuple[int, int]]:
    """Cut ``range(length)`` into ``each`` pieces a thread, so that none waits long; one thread needs one piece."""
    return split_range(length, each * threads if threads > 1 else 1)


@contextmanager
def kept_threads() -> Iterator[None]:
    """Keep the threads that `run_tasks` starts until the end, instead of starting them anew for every call.

    To start one takes some 150 us, as long as many a task of a small fit. Those that a caller keeps serve here, too.
    """
    if _kept_pool() is not None:
        yield
        return
    with ThreadPoolExecutor(max(1, cpu_threads() - 1)) as pool:
        token = _kept.set((os.getpid(), pool))
        try:
            yield
        finally:
            _kept.reset(token)


def _kept_pool() -> ThreadPoolExecutor | None:
    """The threads that a caller keeps; a forked process has none of its parent's."""
    process, pool = _kept.get() or (0, None)
    return pool if process == os.getpid() else None


@contextmanager
def _helpers(threads: int) -> Iterator[ThreadPoolExecutor]:
    pool = _kept_pool()
    if pool is not None:
        yield pool
    else:
        with ThreadPoolExecutor(threads) as own:
            yield own


def run_tasks(function: Callable[..., object], tasks: Sequence[tuple]) -> list:
    """Call ``function(*task)`` for every task over the CPU threads; results in the order of the tasks.

    The first exception is raised after the tasks already running have finished.
    """
    # To ask for the threads takes as long as many a task.
    threads = min(cpu_threads(), len(tasks)) if len(tasks) > 1 else 1
    if threads <= 1:
        return [function(*task) for task in tasks]
    waiting = deque(enumerate(tasks))
    results: list[object] = [None] * len(tasks)

    def work() -> None:
        while True:
            try:
                index, task = waiting.popleft()
            except IndexError:
                return
            try:
                results[index] = function(*task)
            except BaseException:
                waiting.clear()
                raise

    with _helpers(threads - 1) as pool:
        helpers = [pool.submit(work) for _ in range(threads - 1)]
        try:
            work()
        finally:
            # One that has not begun finds nothing left to do, and may never begin where helpers wait for helpers.
            begun = [helper for helper in helpers if not helper.cancel()]
            wait(begun)
    for helper in begun:
        helper.result()
    return results


def of_parts(function: Callable[[np.ndarray], Any], array: np.ndarray) -> list:
    """What a function gives of runs of the first axis that make up an array, by several threads where it is large."""
    parts = split_range(len(array), array.nbytes // _LOOKED_AT_AT_ONCE) if len(array) else []
    return run_tasks(function, [(array[a:b],) for a, b in parts])


def copy_array(to: np.ndarray, source: np.ndarray) -> None:
    """``to[...] = source``, by several threads where it is large."""

    def fill(first: int, last: int) -> None:
        # What the type cannot hold becomes infinite.
        with np.errstate(over="ignore"):
            to[first:last] = source[first:last]

    parts = min(4 * cpu_threads(), to.nbytes // _COPIED_AT_ONCE)
    run_tasks(fill, split_range(len(to), parts) if len(to) else [])


def contiguous(array: np.ndarray, dtype: DTypeLike) -> np.ndarray:
    """``np.ascontiguousarray(array, dtype)``, copied by several threads where it must be copied."""
    if array.flags.c_contiguous and array.dtype == dtype:
        return array
    copy = np.empty(array.shape, dtype)
    copy_array(copy, array)
    return copy
