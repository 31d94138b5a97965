"""SIGKILL at a random moment of a write: the old file or the new one is there, and the next write goes well."""

from __future__ import annotations

import logging
import random
import tempfile
import time
from pathlib import Path

import numpy as np

from .forks import child, killed
from .record import Record
from .writers import Writer, content, remove, writers

__all__ = ["kills"]

FIT = "fit with checkpoint"
# Every so many, nothing is there before; of a fit, it is let run to its end after so many kills in a row.
FIRST, ROW = 5, 4


def kills(record: Record, seed: int, count: int, until: float, names: list[str] | None = None) -> None:
    """Kill so many writes, as many of each writer, until the clock says `until`."""
    chance = random.Random(seed)
    with tempfile.TemporaryDirectory() as place:
        parts = [_Killed(one, Path(place), record, chance) for one in writers(Path(place), names)]
        if names is None or FIT in names:
            parts.append(_KilledFit(Path(place), record, chance))
        done = 0
        while done < count and time.monotonic() < until:
            for part in parts:
                if done < count and time.monotonic() < until:
                    done += part.once()
        parts[-1].end()


class _Killed:
    """One writer, its two whole files, and how long it takes."""

    def __init__(self, writer: Writer, place: Path, record: Record, chance: random.Random) -> None:
        self.what, self.write, self.record, self.chance = f"kill: {writer.name}", writer.write, record, chance
        self.path = place / writer.name.replace(" ", "_").strip("/") / writer.file
        self.path.parent.mkdir()
        self.whole = []
        for state in (1, 0):
            # In this process, so that a child need import nothing, and its time is that of writing.
            self.write(self.path, state)
            begun = time.monotonic()
            self.write(self.path, state)
            self.seconds = time.monotonic() - begun
            self.whole.insert(0, content(self.path))
        self.tries = 0

    def once(self) -> int:
        """Whether a write was killed, and did not end before."""
        self.tries += 1
        if first := self.tries % FIRST == 0:
            remove(self.path)
        there = content(self.path)
        state = 1 if there == self.whole[0] else 0
        status = killed(lambda: self.write(self.path, state), self.chance.uniform(0, 1.1 * self.seconds))
        now = content(self.path)
        if status == -9:
            self.record.tried(self.what)
        elif status:
            self.record.found(self.what, "crashed", f"{self.what}: status {status}")
        if now is None and not first:
            self.record.found(self.what, "lost", f"{self.what}: nothing is there")
        elif now is not None and now not in self.whole:
            self.record.found(self.what, "mixed", f"{self.what}: neither the old one nor the new one")
        if self.tries % FIRST == 1 or now not in self.whole:
            self._again(state)
        return int(status == -9)

    def _again(self, state: int) -> None:
        """What is left of the killed one is in nobody's way."""
        if child(lambda: self.write(self.path, state)) or content(self.path) != self.whole[state]:
            self.record.found(self.what, "lost", f"{self.what}: nothing can be written any more")

    def end(self) -> None:
        pass


class _KilledFit:
    """A fit that is killed and goes on from its checkpoint: to the volume of the fit that was not."""

    def __init__(self, place: Path, record: Record, chance: random.Random) -> None:
        self.what, self.record, self.chance, self.row = f"kill: {FIT}", record, chance, 0
        self.path, self.volume = place / "fit.npz", place / "volume.npy"
        self._run()
        self._clear()
        begun = time.monotonic()
        self._run()
        self.seconds, self.whole = time.monotonic() - begun, np.load(self.volume)
        self._clear()

    def _run(self) -> None:
        import tomo_polysplat as tps
        from tomo_polysplat.plan import checkpoint

        # At every chance, not only when it costs little.
        checkpoint._LARGEST_SHARE = 1e9
        logging.disable(logging.WARNING)
        scan = tps.simulate_scan("pins", size=20, views=24, geometry="fan")
        settings = {"passes": 12.0, "views_per_step": 4}
        result = tps.reconstruct(scan, settings=settings, checkpoint=self.path, resume=True, calibrate=False)
        np.save(self.volume, result.volume)

    def once(self) -> int:
        if self.row == ROW:
            self.end()
        status = killed(self._run, self.chance.uniform(0.1, 1.0) * self.seconds)
        if status == -9:
            self.row += 1
            self.record.tried(self.what)
        else:
            self._judge(status)
        return int(status == -9)

    def end(self) -> None:
        """Let it go on to its end."""
        if self.row:
            self._judge(child(self._run))

    def _judge(self, status: int) -> None:
        if status:
            self.record.found(self.what, "lost", f"{self.what}: it does not go on, status {status}")
        elif not np.array_equal(np.load(self.volume), self.whole):
            self.record.found(self.what, "mixed", f"{self.what}: another volume after {self.row} kills")
        self._clear()

    def _clear(self) -> None:
        self.row = 0
        for path in (self.path, self.volume):
            remove(path)
