"""Ctrl-C while something is finished that must not be lost."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

__all__ = ["Interruption", "postponed_interrupts"]

logger = logging.getLogger(__name__)


@dataclass
class Interruption:
    """Whether somebody has pressed Ctrl-C."""

    asked: bool = False


@contextmanager
def postponed_interrupts(doing: str) -> Iterator[Interruption]:
    """Finish a block in spite of a first Ctrl-C; a second one interrupts it.

    Only the main thread is told of Ctrl-C, so that elsewhere there is nothing to do. A handler of the caller's
    own stays in place.

    Parameters
    ----------
    doing : str
        What is finished, for the log.
    """
    interruption = Interruption()
    ours = threading.current_thread() is threading.main_thread()
    if not ours or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield interruption
        return

    def note(number: int, frame: Any) -> None:
        if interruption.asked:
            raise KeyboardInterrupt
        interruption.asked = True
        logger.warning("Interrupted: %s is finished first; interrupt again to give it up.", doing)

    signal.signal(signal.SIGINT, note)
    try:
        yield interruption
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
