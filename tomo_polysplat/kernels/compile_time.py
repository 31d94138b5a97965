"""Seconds that compiling kernels takes, which are no part of a time budget: they come once a machine."""

from __future__ import annotations

import importlib
import sys
import threading
import time
from typing import Any

__all__ = ["compiled_seconds", "track_compiling", "working_time"]

_now = time.perf_counter
_lock = threading.Lock()
_tracked = _tracked_triton = False
_seconds = 0.0


def working_time() -> float:
    """Seconds of ``time.perf_counter``, less what compiling has taken since `track_compiling` was called first."""
    return _now() - _seconds


def compiled_seconds() -> float:
    """Seconds that this process has compiled for since `track_compiling` was called first."""
    return _seconds


def add_compiled(seconds: float) -> None:
    """Take seconds off `working_time`."""
    global _seconds
    with _lock:
        _seconds += max(seconds, 0.0)


def add_waited(seconds: float) -> None:
    """Count seconds of waiting for another process that compiles, if compiling is tracked."""
    if _tracked:
        add_compiled(seconds)


def track_compiling() -> None:
    """Listen to numba's and triton's compilers from now on; a compiler that does not tell is not counted.

    Triton is left alone where it is not loaded and torch finds no GPU that would need it: importing it takes 0.3 s.
    """
    global _tracked, _tracked_triton
    import torch

    with _lock:
        numba_too, _tracked = not _tracked, True
        triton_too = not _tracked_triton and ("triton" in sys.modules or torch.cuda.is_available())
        _tracked_triton = _tracked_triton or triton_too
    if numba_too:
        _listen_to_numba()
    if triton_too:
        _listen_to_triton()


def _listen_to_numba() -> None:
    from numba.core import event

    class Listener(event.Listener):
        """One function may be compiled amid another: only the outermost counts."""

        def __init__(self) -> None:
            self.own = threading.local()

        def on_start(self, _: Any) -> None:
            self.own.depth = getattr(self.own, "depth", 0) + 1
            if self.own.depth == 1:
                self.own.begun = _now()

        def on_end(self, _: Any) -> None:
            # Registered amid a compilation, it may see an end without a beginning.
            depth = getattr(self.own, "depth", 0)
            self.own.depth = max(depth - 1, 0)
            if depth == 1:
                add_compiled(_now() - self.own.begun)

    event.register("numba:compile", Listener())


def _listen_to_triton() -> None:
    try:
        compilation = importlib.import_module("triton.knobs").compilation
    except (ImportError, AttributeError):  # none, or one from before it told of its compilations
        return
    before = compilation.listener

    def listen(**told: Any) -> None:
        if before is not None:
            before(**told)
        if not told.get("cache_hit", False):
            # Microseconds.
            add_compiled(1e-6 * getattr(told.get("times"), "total", 0))

    compilation.listener = listen
