"""The processes of several devices: started by this one, or by torchrun."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist

from tomo_polysplat.checks import fail
from tomo_polysplat.parallel import cpu_threads
from tomo_polysplat.ranks import RankFailed, Ranks, join, join_here, leave, led_by

__all__ = [
    "TORCHRUN",
    "devices_of",
    "here",
    "rank_of_torchrun",
    "share_out",
    "sharing",
    "sharing_ends",
    "started_by_torchrun",
]

# In place of devices: those of the processes that torchrun has started.
TORCHRUN = "torchrun"
_ENDS: ContextVar[ExitStack] = ContextVar("_ENDS")
# Seconds that a process may take to start.
_START = 120.0
# Between two looks at whether all processes still run.
_LOOK = 0.5


def devices_of(devices: Any, device: str) -> list[str] | None:
    """Names of the devices that share out a fit; None for ``device`` alone.

    Parameters
    ----------
    devices : None, "all", "0,1", "torchrun", or sequence of device names and numbers of GPUs
    device : str
        Beside ``devices`` "auto", except with torchrun, whose processes know theirs.

    Raises
    ------
    ValueError
        If a device is named twice, or they are of several kinds, or ``device`` names another one.
    """
    if devices is None or devices == TORCHRUN:
        return None
    if device != "auto":
        raise fail(
            "device", "'auto' beside devices", repr(device), "the first of devices is the first one used"
        )
    if isinstance(devices, str) and devices == "all":
        return [f"cuda:{k}" for k in range(torch.cuda.device_count())] or None
    if isinstance(devices, str):
        devices = [part.strip() for part in devices.split(",")]
    if isinstance(devices, int) or not isinstance(devices, Sequence) or not len(devices):
        raise fail("devices", "'all', or numbers of GPUs such as [0, 1]", repr(devices))
    names = [f"cuda:{int(one)}" if str(one).strip().isdigit() else str(one) for one in devices]
    kinds = {name.partition(":")[0] for name in names}
    gpus = [name for name in names if name != "cpu"]
    if len(kinds) > 1 or len(set(gpus)) < len(gpus) or "cuda" in names:
        raise fail("devices", "different GPUs by number, or 'cpu' several times", repr(devices))
    return names


def started_by_torchrun() -> bool:
    """Whether this is one of several processes that torchrun has started."""
    return "TORCHELASTIC_RUN_ID" in os.environ and int(os.environ.get("WORLD_SIZE", "1")) > 1


def rank_of_torchrun(device: str = "auto") -> Ranks:
    """This process among those of torchrun, on the GPU of its number, or on the CPU where there are none."""
    rank, count = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
    local = int(os.environ.get("LOCAL_RANK", rank))
    gpus = torch.cuda.device_count() if device != "cpu" else 0
    if gpus and local >= gpus:
        raise fail(
            "--nproc-per-node", f"at most {gpus} processes, a GPU each", f"rank {rank} is the {local + 1}th"
        )
    here = torch.device("cuda", local) if gpus else torch.device("cpu")
    store, _, _ = next(dist.rendezvous("env://"))
    return Ranks(rank, count, here, store)


@contextmanager
def sharing(devices: Sequence[torch.device] | Ranks | None) -> Iterator[None]:
    """Share out over devices the steps of all fits within.

    Parameters
    ----------
    devices : sequence of torch.device, Ranks or None
        With fewer than two of them nothing is shared. Ranks are those of `rank_of_torchrun`.

    Raises
    ------
    RankFailed
        If a process does not start.
    """
    if devices is None or (not isinstance(devices, Ranks) and len(devices) < 2):
        yield
        return
    if dist.is_initialized():
        remedy = "one run over several devices at a time, in a process that has no group of its own"
        raise fail("devices", "no torch.distributed group yet", "one", remedy)
    started: _Started | None = None
    if isinstance(devices, Ranks):
        ranks = devices
    else:
        started = _Started(devices)
        ranks = started.ranks()
    done = threading.Event()

    def connect() -> None:
        if started is None:
            join(ranks)
        else:
            started.join_all(ranks)
        if ranks.device.type == "cuda":
            threading.Thread(target=_look_after, args=(ranks, done), daemon=True).start()

    # As late as can be: the others start meanwhile.
    ranks.connect = connect
    try:
        with led_by(ranks):
            yield
        if started is None and ranks.usable:
            with ranks.together():
                ranks.tell("end")
    finally:
        done.set()
        ranks.leave()
        leave()
        if started is not None:
            started.end()


@contextmanager
def sharing_ends() -> Iterator[None]:
    """End with this block what `share_out` begins in it."""
    with ExitStack() as stack:
        before = _ENDS.set(stack)
        try:
            yield
        finally:
            _ENDS.reset(before)


def share_out(devices: Sequence[torch.device] | Ranks | None) -> None:
    """Begin `sharing`, until the end of `sharing_ends`; processes start while this one does other things."""
    _ENDS.get().enter_context(sharing(devices))


def _look_after(ranks: Ranks, done: threading.Event) -> None:
    """End what waits on a GPU for a process that is no more: NCCL does not notice."""
    while not done.wait(_LOOK):
        if (failed := ranks.failure()) is not None:
            ranks.failed = failed
            leave()
            return


def here(rank: int) -> str:
    """The key that a process sets once it has started."""
    return f"tomo_polysplat/here/{rank}"


def _keys(ranks: Ranks) -> list[str]:
    return [here(rank) for rank in range(1, ranks.count)]


class _Started:
    """Processes that follow this one."""

    def __init__(self, devices: Sequence[torch.device]) -> None:
        self._devices, self._folder = devices, tempfile.mkdtemp(prefix="tomo-polysplat-")
        package = str(Path(__file__).resolve().parents[1])
        paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
        threads = str(max(1, cpu_threads() // len(devices)))
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": threads}
        self._processes = [
            subprocess.Popen(
                [sys.executable, "-m", "tomo_polysplat.fit.follow", self._folder]
                + [str(rank), str(len(devices)), str(device)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                env=environment,
            )
            for rank, device in enumerate(devices)
            if rank
        ]

    def ranks(self) -> Ranks:
        """This process as the first of all."""
        store = dist.FileStore(os.path.join(self._folder, "store"), len(self._devices))
        ranks = Ranks(0, len(self._devices), self._devices[0], store, self.why_ended)
        ranks.all_here = lambda: store.check(_keys(ranks))
        return ranks

    def why_ended(self) -> str:
        """Words on the first process that has failed; none while all run or have ended well."""
        for rank, process in enumerate(self._processes, 1):
            if process.poll():
                code = process.returncode
                how = f"was ended by signal {-code}" if code < 0 else f"ended with status {code}"
                return f"rank {rank} of {len(self._devices)} ({self._devices[rank]}) {how}"
        return ""

    def join_all(self, ranks: Ranks) -> None:
        """Connect with all of them."""
        self._wait_for_all(ranks)
        join_here(ranks)

    def _wait_for_all(self, ranks: Ranks) -> None:
        end = time.monotonic() + _START
        while not ranks.store.check(_keys(ranks)):
            if (failed := ranks.failure()) is not None:
                raise failed
            if time.monotonic() > end:
                raise RankFailed(f"not all of {ranks.count} processes had started after {_START:g} s")
            time.sleep(0.02)

    def end(self) -> None:
        """Leave none behind; they have nothing to lose."""
        for process in self._processes:
            process.kill()
        for process in self._processes:
            process.wait()
            assert process.stdin is not None
            process.stdin.close()
        shutil.rmtree(self._folder, ignore_errors=True)
