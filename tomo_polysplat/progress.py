"""How far a run is, for people who wait for it."""

from __future__ import annotations

import sys
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail

__all__ = ["TimeLeft", "progress_reports"]

# The share of a run by which is told how fast it is now, that which has to be seen before anything is said, and how far
# apart the reports are that are kept of many.
_RECENT, _ENOUGH, _APART = 0.1, 0.03, 0.004


@contextmanager
def progress_reports(
    wanted: bool | Callable[[float, str], Any] | None,
) -> Iterator[Callable[[float, str], Any]]:
    """A function of (share done, words) for the length of a run.

    Parameters
    ----------
    wanted : bool, callable or None
        The function itself, or whether to draw a bar: in a notebook below the cell, else on standard error. None
        draws it in a notebook and on a terminal only, so that logs stay readable.
    """
    if callable(wanted):
        yield wanted
        return
    if not (wanted is None or isinstance(wanted, (int, np.bool_))):
        raise fail("progress", "True, False, None or a function", repr(wanted), error=TypeError)
    if wanted is not None and not wanted:
        yield _silent
        return
    tqdm, in_notebook = _bars()
    drawn = in_notebook or _is_terminal(sys.stderr) if wanted is None else bool(wanted)
    layout = "{l_bar}{bar}| {elapsed}{postfix}" if in_notebook else "{l_bar}{bar:24}| {elapsed}{postfix}"
    left = TimeLeft()
    options = {"bar_format": layout, "disable": not drawn, "leave": False}
    with _whole_log_lines(drawn and not in_notebook), tqdm(total=1.0, **options) as bar:

        def report(share: float, words: str = "") -> None:
            told = left.told(share, time.perf_counter())
            bar.set_postfix_str(", ".join(filter(None, (told, words))), refresh=False)
            # Drawn at once: a stage that makes no progress of its own is shown all the same.
            bar.n = min(share, 1.0)
            bar.refresh()

        yield report


def _silent(share: float, words: str = "") -> None:
    """For those who want no bar."""


class TimeLeft:
    """The time that a run takes at most, from how fast it has been of late.

    What comes before the first progress (calibration, start, compiling) says nothing about the rest: nothing is told
    until progress has been seen going on, and again after it has fallen back because a fit begins anew.
    """

    def __init__(self) -> None:
        self._seen: deque[tuple[float, float]] = deque()

    def told(self, share: float, now: float) -> str:
        """In words, or nothing.

        Parameters
        ----------
        share : float
            Done, from 0 to 1.
        now : float
            Seconds of any clock.
        """
        if share <= 0 or (self._seen and share < self._seen[-1][0]):
            self._seen.clear()
        if share >= 1 or share <= 0:
            return ""
        if not self._seen or share - self._seen[-1][0] >= _APART:
            self._seen.append((share, now))
        while len(self._seen) > 2 and share - self._seen[1][0] >= _RECENT:
            self._seen.popleft()
        first, then = self._seen[0]
        if share - first < _ENOUGH or now <= then:
            return ""
        return f"at most {_words((1 - share) * (now - then) / (share - first))} left"


def _words(seconds: float) -> str:
    """Seconds as exactly as an estimate is."""
    if seconds < 170:
        step = 1 if seconds < 10 else 5 if seconds < 60 else 10
        return f"{max(1, step * round(seconds / step))} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes / 60:.1f} h"


def _bars() -> tuple[Any, bool]:
    """The class of bars for where this runs, and whether that is a notebook."""
    with warnings.catch_warnings():
        # Of a notebook without ipywidgets, where bars are plain text.
        warnings.simplefilter("ignore")
        from tqdm.auto import tqdm

    # Loaded by now if it was chosen; elsewhere it would load ipywidgets in vain.
    notebook = sys.modules.get("tqdm.notebook")
    return tqdm, notebook is not None and issubclass(tqdm, notebook.tqdm_notebook)


def _is_terminal(stream: Any) -> bool:
    return stream is not None and stream.isatty()


def _whole_log_lines(drawn: bool) -> Any:
    """Lines of the log that go to the terminal above the bar, not into it."""
    if not drawn:
        return nullcontext()
    from tqdm.contrib.logging import logging_redirect_tqdm

    return logging_redirect_tqdm()
