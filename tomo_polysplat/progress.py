"""How far a run is, for people who wait for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail

__all__ = ["progress_reports"]


@contextmanager
def progress_reports(
    wanted: bool | Callable[[float, str], Any] | None,
) -> Iterator[Callable[[float, str], Any]]:
    """A function of (share done, words) for the length of a run.

    Parameters
    ----------
    wanted : bool, callable or None
        The function itself, or whether to draw a bar on standard error; None draws it on a terminal only, so
        that logs stay readable.
    """
    if callable(wanted):
        yield wanted
        return
    if not (wanted is None or isinstance(wanted, (int, np.bool_))):
        raise fail("progress", "True, False, None or a function", repr(wanted), error=TypeError)
    from tqdm import tqdm

    layout = "{l_bar}{bar:24}| {elapsed}<{remaining} {postfix}"
    disable = None if wanted is None else not wanted
    # Left to itself tqdm draws after as much progress as it has seen in a while, which one slow step makes rare.
    with tqdm(total=1.0, bar_format=layout, disable=disable, leave=False, miniters=0) as bar:

        def report(share: float, words: str = "") -> None:
            bar.set_postfix_str(words, refresh=False)
            bar.update(min(share, 1.0) - bar.n)

        yield report
