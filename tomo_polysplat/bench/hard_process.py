"""A process in which cases run, so that one that crashes or hangs ends there."""

from __future__ import annotations

import multiprocessing
import time
import warnings
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any

from tomo_polysplat.bench.hard_cases.case import Case

__all__ = ["Outcome", "Worker", "run_here"]

# Seconds that a new process gets on top of its first case, to import and to compile.
_START = 180.0


@dataclass
class Outcome:
    """What came of a case.

    Attributes
    ----------
    passed : bool
    seconds : float
        Wall clock, in the process that ran it.
    error : str
        What was raised, or how the process ended; empty when the case came to its end.
    findings : list of dict
        The entries of its :class:`~tomo_polysplat.bench.hard_cases.case.Findings`.
    """

    passed: bool
    seconds: float
    error: str = ""
    findings: list[dict[str, Any]] = field(default_factory=list)


def run_here(case: Case, device: str) -> Outcome:
    """Run a case in this process; whatever it raises is its outcome, and so is any RuntimeWarning of NumPy."""
    started = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            findings = case.run(device)
    except Exception as error:
        return Outcome(False, time.perf_counter() - started, f"{type(error).__name__}: {error}")
    return Outcome(findings.passed, time.perf_counter() - started, "", findings.entries)


def _serve(connection: Connection, device: str) -> None:
    """Run the cases that come through a pipe until None comes."""
    while (case := connection.recv()) is not None:
        connection.send(run_here(case, device))


class Worker:
    """A process for cases, replaced when it crashes or hangs."""

    def __init__(self, device: str) -> None:
        self._device = device
        # Not forked: a forked process cannot use CUDA, nor threads that its parent had started.
        self._context = multiprocessing.get_context("spawn")
        self._process: Any = None
        self._connection: Any = None

    def __enter__(self) -> Worker:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process is not None and self._process.is_alive() and kind is None:
            self._connection.send(None)
            self._process.join(10.0)
        self._end()

    def run(self, case: Case) -> Outcome:
        """Run a case there and wait for it, no longer than its limit."""
        allowed = case.limit
        if self._process is None:
            self._start()
            allowed += _START
        started = time.perf_counter()
        self._connection.send(case)
        try:
            if self._connection.poll(allowed):
                return self._connection.recv()
            words = f"hung: no end after {allowed:.0f} s"
        except (EOFError, OSError):
            self._process.join(10.0)
            words = f"crashed: the process ended with code {self._process.exitcode}"
        self._end()
        return Outcome(False, time.perf_counter() - started, words)

    def _start(self) -> None:
        self._connection, theirs = self._context.Pipe()
        self._process = self._context.Process(target=_serve, args=(theirs, self._device), daemon=True)
        self._process.start()
        # Held by the other side alone, the pipe breaks when that side is gone.
        theirs.close()

    def _end(self) -> None:
        if self._process is None:
            return
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._connection.close()
        self._process = self._connection = None
