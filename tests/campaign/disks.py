"""Disks and quotas that fill up: an error in words, the old file kept, and the next write goes well.

A quota is a limit on the size of a file. A disk is a small one in memory, which the child alone sees: Linux gives
one without root where it allows user namespaces.
"""

from __future__ import annotations

import ctypes
import os
import random
import resource
import tempfile
import time
from pathlib import Path

from .forks import FAILED, child
from .record import Record
from .writers import Writer, content, writers

__all__ = ["full_disks"]

SAVED, CHANGED, LEFT, DEAD, NO_DISK = 10, 11, 12, 13, 14
FAULTS = {CHANGED: "lost", LEFT: "mixed", DEAD: "lost", FAILED: "crashed"}
WORDS = {
    CHANGED: "the old file is another",
    LEFT: "a part is left",
    DEAD: "nothing can be written any more",
    FAILED: "another error",
}
_NEW_USER, _NEW_MOUNTS, _PRIVATE = 0x10000000, 0x00020000, 0x40000 | 0x4000


def full_disks(record: Record, seed: int, count: int, until: float, names: list[str] | None = None) -> None:
    """Fill up so many disks, as many under each writer, until the clock says `until`."""
    chance, done = random.Random(seed), 0
    with tempfile.TemporaryDirectory() as place:
        some = writers(Path(place), names)
        sizes = [_bytes_of(one, Path(place)) for one in some]
        kinds = [("quota", _quota)] + (
            [("disk", _disk)] if child(lambda: _mounted(place, 2**20)) == 0 else []
        )
        while done < count and time.monotonic() < until:
            for kind, action in kinds:
                for writer, (largest, whole) in zip(some, sizes):
                    if done >= count or time.monotonic() > until:
                        return
                    size = largest if kind == "quota" else whole
                    where = Path(tempfile.mkdtemp(dir=place))
                    share, late = chance.uniform(0.02, 0.98), chance.random() < 0.7
                    status = child(lambda: action(writer, where, size, share, late))  # noqa: B023  # used at once
                    done += _noted(record, f"{kind}: {writer.name}", status)


def _noted(record: Record, what: str, status: int) -> int:
    # One that had room after all was no full disk.
    if status == SAVED:
        return 0
    record.tried(what)
    if status < 0:
        record.found(what, "crashed", f"{what}: signal {-status}")
    elif status:
        record.found(what, FAULTS[status], f"{what}: {WORDS[status]}")
    return 1


def _bytes_of(writer: Writer, place: Path) -> tuple[int, int]:
    """The largest file and all files of the new state."""
    path = place / f"size.{writer.file}"
    writer.write(path, 1)
    files = path.rglob("*") if path.is_dir() else [path]
    sizes = [inner.stat().st_size for inner in files if inner.is_file()]
    return max(sizes), sum(sizes)


def _quota(writer: Writer, where: Path, size: int, share: float, late: bool) -> int:
    path = where / writer.file
    writer.write(path, 0)
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.setrlimit(resource.RLIMIT_FSIZE, (max(1, int(share * size)), hard))
    return _judged(writer, path, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard)))


def _disk(writer: Writer, where: Path, size: int, share: float, late: bool) -> int:
    # For the old one, the new one, and what folders and blocks take.
    if _mounted(where, 3 * size + 2**21):
        return NO_DISK
    path, filler = where / writer.file, where / "filler"
    writer.write(path, 0)
    if late:  # full only after it has been asked for room
        import tomo_polysplat.files
        import tomo_polysplat.folders

        tomo_polysplat.files.require_room = tomo_polysplat.folders.require_room = lambda *_: None
    disk = os.statvfs(where)
    with open(filler, "wb") as file:
        file.write(b"1" * max(0, disk.f_bavail * disk.f_frsize - int(share * size)))
    return _judged(writer, path, filler.unlink)


def _judged(writer: Writer, path: Path, give_room) -> int:
    """Write on the full disk, and again when there is room: what came of it."""
    old, beside = content(path), {inner.name for inner in path.parent.iterdir()}
    try:
        writer.write(path, 1)
        status = SAVED
    except OSError as error:
        status = 0 if str(error) else FAILED
        if content(path) != old:
            return CHANGED
        if {inner.name for inner in path.parent.iterdir()} != beside:
            return LEFT
    give_room()
    try:
        writer.write(path, 1)
    except OSError:
        return DEAD
    return status if content(path) != old else DEAD


def _mounted(where: str | Path, size: int) -> int:
    """Put a disk of so many bytes there, for this process alone; 0 if that is allowed."""
    system, user, group = ctypes.CDLL(None, use_errno=True), os.getuid(), os.getgid()
    if not hasattr(system, "unshare"):
        return 1
    if system.unshare(_NEW_MOUNTS):
        if system.unshare(_NEW_USER | _NEW_MOUNTS):
            return 1
        for name, text in (("setgroups", "deny"), ("uid_map", f"0 {user} 1"), ("gid_map", f"0 {group} 1")):
            Path("/proc/self", name).write_text(text)
    system.mount(b"none", b"/", None, _PRIVATE, None)
    return int(system.mount(b"tmpfs", os.fsencode(where), b"tmpfs", 0, f"size={size}".encode()) != 0)
