"""Imports that leave the process as it was: other packages set environment variables and warning filters as they load.

A child process of the caller would inherit the one, and the caller's own warnings meet the other. And what they load
stays: the garbage collector rests meanwhile, which would look through all of it a dozen times.
"""

from __future__ import annotations

import atexit
import gc
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["ending_quickly", "leaving_no_trace"]


@contextmanager
def leaving_no_trace() -> Iterator[None]:
    """Take back what is done to environment variables and warning filters within; for imports alone.

    Around more it would take back what a callback or another thread does meanwhile.
    """
    before, collects = dict(os.environ), gc.isenabled()
    gc.disable()
    try:
        with warnings.catch_warnings():
            yield
    finally:
        if collects:
            gc.enable()
        for name in os.environ.keys() - before.keys():
            del os.environ[name]
        os.environ.update({name: value for name, value in before.items() if os.environ.get(name) != value})


def ending_quickly() -> None:
    """Let this process, which is ours alone, end without a last look through all that is loaded.

    Python frees circles of objects once more before it ends, which takes a second with torch's; the system frees all.
    Triton's would complain that they were not freed.
    """
    atexit.unregister(_keep_all)
    atexit.register(_keep_all)


def _keep_all() -> None:
    if "triton" not in sys.modules:
        gc.freeze()
