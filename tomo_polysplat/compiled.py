"""Numba's ``njit`` for the package's own functions: compiled while the garbage collector rests.

The compiler makes millions of small objects, most of which live until a function is done. To look through them again
and again takes a quarter of the seconds of compiling (numba 0.68, Python 3.11) and finds next to nothing.
"""

from __future__ import annotations

import gc
from typing import Any

from numba import njit
from numba.core import event

__all__ = ["njit"]


class _Rest(event.Listener):
    """The collector rests while the outermost function is compiled; numba compiles in one thread at a time."""

    def __init__(self) -> None:
        self.depth, self.collects = 0, False

    def on_start(self, _: Any) -> None:
        self.depth += 1
        if self.depth == 1:
            self.collects = gc.isenabled()
            gc.disable()

    def on_end(self, _: Any) -> None:
        # Registered amid a compilation, it sees an end without a beginning.
        self.depth = max(self.depth - 1, 0)
        if self.depth == 0 and self.collects:
            gc.enable()


event.register("numba:compile", _Rest())
