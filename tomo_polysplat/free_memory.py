"""How much memory a process may still take, and refusing what would not fit before any of it is taken.

A system that runs out of memory swaps for hours or kills the process. What a job may take may be less than what the
machine has: a container, or a queue's job, has a control group with a limit.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from tomo_polysplat.checks import fail

__all__ = ["available_memory", "in_gigabytes", "require_memory"]

_MEMINFO, _OWN_GROUPS, _GROUPS = Path("/proc/meminfo"), Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
# Limit, use, and what of the use is files that the system can let go of, in both versions of control groups.
_VERSIONS = {
    "": ("memory.max", "memory.current", "inactive_file "),
    "memory": ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file "),
}


def available_memory() -> int | None:
    """Bytes of memory that a process may still take, or None where the system does not say."""
    free = []
    with suppress(OSError):
        for line in _MEMINFO.read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                free.append(int(line.split()[1]) * 1024)
    free += _left_in_groups()
    return min(free, default=None)


def require_memory(needed: Mapping[str, tuple[str, float]], remedies: Mapping[str, str]) -> None:
    """Refuse what takes more memory than there is.

    Parameters
    ----------
    needed : mapping
        By argument: what it asks for, in words, and its bytes.
    remedies : mapping
        By argument: what the caller can do.

    Raises
    ------
    MemoryError
        For the argument that takes the most, with bytes needed, bytes free, and its remedy.
    """
    there, total = available_memory(), sum(size for _, size in needed.values())
    if there is None or total <= there:
        return
    worst = max(needed, key=lambda name: needed[name][1])
    parts = ", ".join(
        f"{words} {in_gigabytes(size)}" for words, size in needed.values() if size > 0.01 * total
    )
    raise fail(
        worst,
        f"what fits into the {in_gigabytes(there)} of memory that are free",
        f"about {in_gigabytes(total)} ({parts})",
        remedies[worst],
        MemoryError,
    )


def in_gigabytes(size: float) -> str:
    """Bytes as text."""
    return f"{size / 1e9:.2f} GB"


def _left_in_groups() -> list[int]:
    """Bytes left in the control groups of this process, and in those around them, that have a limit."""
    left = []
    with suppress(OSError):
        for line in _OWN_GROUPS.read_text(encoding="utf-8").splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers in ("", "memory"):
                root = _GROUPS / controllers
                own = root / path.lstrip("/")
                # Inside a container the path may be that outside of it, and its own group is the root.
                for folder in (own, *own.parents):
                    if folder == root or root in folder.parents:
                        left += _left_in(folder, *_VERSIONS[controllers])
    return left


def _left_in(folder: Path, limit: str, usage: str, files: str) -> list[int]:
    with suppress(OSError, ValueError):  # "max" is no number, and no limit
        most, taken = (int((folder / name).read_text(encoding="ascii")) for name in (limit, usage))
        stat = (folder / "memory.stat").read_text(encoding="ascii").splitlines()
        spare = sum(int(line.split()[1]) for line in stat if line.startswith(files))
        return [max(most - taken + spare, 0)]
    return []
