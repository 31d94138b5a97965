"""Hostile files of every kind that is read, in one process that is started again after it has ended."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from .record import Record
from .worker import BYTES, SECONDS

__all__ = ["hostile_files"]

BATCH = 100
WORKER = Path(__file__).with_name("worker.py")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "fuzz"))


class Worker:
    """The process, which is there whenever it is asked for."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._said = tempfile.TemporaryFile("w+", errors="replace")  # noqa: SIM115  # closed with the object

    def run(self, task: dict) -> Iterator[dict]:
        """What it tells of each case; of one that it ends with, ``ended`` and the last words."""
        process = self._started()
        process.stdin.write(json.dumps(task) + "\n")
        process.stdin.flush()
        for line in process.stdout:
            if line == "done\n":
                return
            if line != "begun\n":
                yield json.loads(line)
        status = process.wait()
        self._process = None
        self._said.seek(0)
        yield {"ended": status, "words": self._said.read()[-3000:]}

    def _started(self) -> subprocess.Popen[str]:
        if self._process is None:
            self._said.seek(0)
            self._said.truncate()
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": self._said}
            self._process = subprocess.Popen([sys.executable, str(WORKER)], text=True, **pipes)
            if self._process.stdout.readline() != "ready\n":
                raise RuntimeError(f"the worker does not start (status {self._process.wait()})")
        return self._process

    def end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def hostile_files(
    record: Record, seed: int, count: int, until: float, targets: list[str] | None = None
) -> None:
    """Try `count` files, as many of each kind, until the clock says `until`."""
    from targets import FILES

    names, worker, number = targets or list(FILES), Worker(), 0
    left = {name: -(-count // len(names)) for name in names}
    try:
        while any(left.values()) and time.monotonic() < until:
            for name in names:
                if not left[name] or time.monotonic() > until:
                    continue
                task = {"target": name, "seed": f"{seed}.{number}", "count": min(BATCH, left[name])}
                left[name] -= task["count"]
                for case in worker.run(task):
                    _note(record, name, task["seed"], case)
            number += 1
    finally:
        worker.end()


def _note(record: Record, name: str, seed: str, case: dict) -> None:
    where = f"{name}, seed {seed}"
    record.tried(f"file: {name}")
    if "ended" in case:
        slow = case["ended"] == -27 or "Timeout (" in case["words"]
        words = f"{where}: status {case['ended']}\n{case['words']}"
        record.found(f"file: {name}", "over time" if slow else "crashed", words)
        return
    record.count(f"file: {name}", "accepted", int(case["accepted"]))
    record.largest(f"file: {name}", case["seconds"], case["bytes"])
    memory = case["bytes"] > BYTES or str(case["found"]).startswith("memory")
    if memory:
        record.found(
            f"file: {name}", "over memory", f"{where}: {case['bytes'] / 2**20:.0f} MB, {case['found']}"
        )
    elif case["seconds"] > SECONDS:
        record.found(f"file: {name}", "over time", f"{where}: {case['seconds']:.1f} s")
    elif case["found"]:
        record.found(f"file: {name}", "no words", f"{where}: {case['found']}")
