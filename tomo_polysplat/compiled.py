"""Numba's ``njit`` for the package's own functions, so that they compile in two thirds of the time.

Functions that Python does not call, and those that C does not call, are compiled without a form for that. And the
garbage collector rests: the compiler makes millions of small objects that live until a function is done, and to look
through them again and again took up to a quarter of the seconds (numba 0.68, Python 3.11).
"""

from __future__ import annotations

import functools
import gc
from typing import Any

import numba
from numba.core import event

__all__ = ["called", "njit"]

# For functions that Python calls, and for those that only compiled functions call.
njit = functools.partial(numba.njit, no_cfunc_wrapper=True)
called = functools.partial(njit, no_cpython_wrapper=True)


class _Rest(event.Listener):
    """The collector rests while the outermost function is compiled, if it is ours; numba compiles one at a time."""

    def __init__(self) -> None:
        self.depth, self.collects = 0, False

    def on_start(self, begun: Any) -> None:
        self.depth += 1
        if self.depth == 1:
            self.collects = gc.isenabled() and _is_ours(begun.data["dispatcher"])
            if self.collects:
                gc.disable()

    def on_end(self, _: Any) -> None:
        # Registered amid a compilation, it sees an end without a beginning.
        self.depth = max(self.depth - 1, 0)
        if self.depth == 0 and self.collects:
            self.collects = False
            gc.enable()


def _is_ours(dispatcher: Any) -> bool:
    """Whether the function is the package's own: others' are compiled as they would be without it."""
    return str(dispatcher.py_func.__module__).startswith(f"{__package__}.")


event.register("numba:compile", _Rest())
