"""Children of this process, which have all that it has imported, and may be ended without harm."""

from __future__ import annotations

import faulthandler
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable

__all__ = ["FAILED", "child", "killed"]

FAILED = 99
_LONGEST = 60.0


def child(action: Callable[[], int | None]) -> int:
    """The status of a child that does something; below 0 the number of the signal that has ended it."""
    return _wait(_fork(action)[0], time.monotonic() + _LONGEST)


def killed(action: Callable[[], int | None], delay: float) -> int:
    """The status of a child that is killed so many seconds after it has begun, if it has not ended before."""
    number, begun = _fork(action)
    os.read(begun, 1)
    os.close(begun)
    return _wait(number, time.monotonic() + delay)


def _wait(number: int, until: float) -> int:
    while time.monotonic() < until:
        done, status = os.waitpid(number, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(min(0.002, max(0.0, until - time.monotonic())))
    os.kill(number, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])


def _fork(action: Callable[[], int | None]) -> tuple[int, int]:
    begun, tell = os.pipe()
    number = os.fork()
    if number:
        os.close(tell)
        return number, begun
    try:
        # One that waits for what it will never get says where; what pytest puts in place of sys.stderr is no file.
        faulthandler.dump_traceback_later(_LONGEST, exit=True, file=sys.__stderr__)
        os.write(tell, b".")
        os._exit(action() or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(FAILED)
