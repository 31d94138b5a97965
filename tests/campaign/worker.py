"""The process that reads hostile files: it takes tasks from its input and tells of every case on its output.

Started by `files.py`. A task is a line of JSON with a target of ``tests/fuzz/targets.py``, a seed and a count. An
answer is ``begun``, or a line of JSON about the case that has ended.
"""

from __future__ import annotations

import faulthandler
import json
import logging
import os
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
from contextlib import suppress
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "fuzz"))

# Of the CPU; of the clock, for what waits without work.
SECONDS, LONGEST_WAIT = 5.0, 60.0
# More than may be taken: so that what is taken is seen.
BYTES, ROOM = 2**30, 2**32


def main() -> None:
    tell = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    logging.disable(logging.CRITICAL)
    from targets import TARGETS

    from tomo_polysplat.physics.materials import mass_attenuation

    mass_attenuation("iron", 60.0)  # loads its tables, which takes seconds once
    _limit_memory()
    # The place of a case that works for too long, before the system ends the process.
    faulthandler.register(signal.SIGPROF, chain=True)
    with tempfile.TemporaryDirectory() as folder:
        tell.write("ready\n")
        for line in sys.stdin:
            task = json.loads(line)
            work(TARGETS[task["target"]], task, Path(folder), lambda text: tell.write(text + "\n"))
            tell.write("done\n")


def work(target, task, folder, tell) -> None:
    """So many cases of a target."""
    from hypothesis import HealthCheck, Phase, given, settings
    from hypothesis import seed as seeded

    action, cases = target

    @seeded(random.Random(f"{task['target']} {task['seed']}").getrandbits(64))
    @settings(
        max_examples=task["count"],
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(cases)
    def run(case):
        tell("begun")
        tell(json.dumps(observed(action, case, folder)))

    run()


def observed(action, case, folder) -> dict:
    """What comes of a case: whether it is read, what was found, CPU seconds and bytes more than before."""
    before, found, accepted = _resident("VmRSS"), None, False
    with suppress(OSError), open("/proc/self/clear_refs", "w") as file:
        file.write("5")  # the largest size so far is forgotten
    begun = time.process_time()
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    faulthandler.dump_traceback_later(LONGEST_WAIT, exit=True)
    try:
        accepted = bool(action(case, folder))
    except Exception as error:
        cause = error.__context__ or error
        place = traceback.extract_tb(cause.__traceback__)[-1]
        found = f"{type(cause).__name__} at {Path(place.filename).name}:{place.lineno}: {str(cause)[:200]}"
        if isinstance(cause, MemoryError):
            found = f"memory: {found}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        faulthandler.cancel_dump_traceback_later()
    return {
        "accepted": accepted,
        "found": found,
        "seconds": time.process_time() - begun,
        "bytes": max(0, _resident("VmHWM") - before),
    }


def _resident(name: str) -> int:
    with suppress(OSError), open("/proc/self/status", encoding="ascii", errors="replace") as file:
        return next(int(line.split()[1]) * 1024 for line in file if line.startswith(name))
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _limit_memory() -> None:
    with suppress(OSError), open("/proc/self/statm", encoding="ascii") as file:
        most = int(file.read().split()[0]) * resource.getpagesize() + ROOM
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


if __name__ == "__main__":
    main()
