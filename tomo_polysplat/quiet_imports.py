"""Imports that leave the process as it was: other packages set environment variables and warning filters as they load.

A child process of the caller would inherit the one, and the caller's own warnings meet the other.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["leaving_no_trace"]


@contextmanager
def leaving_no_trace() -> Iterator[None]:
    """Take back what is done to environment variables and warning filters within; for imports alone.

    Around more it would take back what a callback or another thread does meanwhile.
    """
    before = dict(os.environ)
    try:
        with warnings.catch_warnings():
            yield
    finally:
        for name in os.environ.keys() - before.keys():
            del os.environ[name]
        os.environ.update({name: value for name, value in before.items() if os.environ.get(name) != value})
