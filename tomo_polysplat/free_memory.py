"""How much memory a process may still take, and refusing what would not fit before any of it is taken.

A system that runs out of memory swaps for hours or kills the process. What a job may take may be less than what the
machine has: a container, or a queue's job, has a control group with a limit.
"""

from __future__ import annotations

import functools
import os
import re
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tomo_polysplat.checks import fail, require_number

if TYPE_CHECKING:
    import torch

__all__ = [
    *("MUCH", "available_memory", "bytes_of", "free_bytes", "in_gigabytes"),
    *("give_back", "keeps_more_than", "limit_memory", "memory_limits", "recording", "require_memory"),
]

# Held while a CUDA graph is recorded, which one thread of a process can do at a time. If another one gave memory back
# meanwhile, torch would end that with an error.
recording = threading.Lock()

# Of a device's memory, what torch may keep unused before what is to stay is moved for it to be given back.
MUCH = 0.2

_MEMINFO, _OWN_GROUPS, _GROUPS = Path("/proc/meminfo"), Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
# Limit, use, and what of the use is files that the system can let go of, in both versions of control groups.
_VERSIONS = {
    "": ("memory.max", "memory.current", "inactive_file "),
    "memory": ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file "),
}
# The older version writes a number near 2**63 where there is no limit.
_NO_LIMIT = 2**60
_STATM = Path("/proc/self/statm")
_UNITS = {"": 1.0} | {
    f"{prefix}{binary}b": (1024.0 if binary else 1000.0) ** power
    for power, prefix in enumerate(("", "k", "m", "g", "t"))
    for binary in ("", "i")
    if prefix or not binary
}
# Bytes that a caller lets the host's processes, and a GPU's, hold in all.
_LIMITS: ContextVar[dict[str, float]] = ContextVar("_LIMITS")


@contextmanager
def memory_limits() -> Iterator[None]:
    """Forget at the end what `limit_memory` was told within."""
    before = _LIMITS.set(dict(_LIMITS.get({})))
    try:
        yield
    finally:
        _LIMITS.reset(before)


def limit_memory(size: Any, kind: str) -> None:
    """Plan as if this process may hold no more than so many bytes, on the host ("cpu") or on a GPU ("cuda").

    Nothing is enforced: what is planned stays below. None is no limit.
    """
    if size is not None:
        _LIMITS.set(_LIMITS.get({}) | {kind: bytes_of(size, "memory")})


def bytes_of(value: Any, argument: str) -> float:
    """Bytes of a number, or of a text such as "12 GB", "500MB" or "8 GiB".

    Raises
    ------
    ValueError
        For anything else, and for nothing.
    """
    if not isinstance(value, str):
        return require_number(argument, value, above=0)
    found = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*([a-z]*)\s*", value.lower())
    if found is None or found[2] not in _UNITS or not float(found[1]) > 0:
        raise fail(argument, 'bytes, as a number or as "12 GB", "500 MB" or "8 GiB"', repr(value))
    return float(found[1]) * _UNITS[found[2]]


def free_bytes(device: torch.device) -> int:
    """Memory of a CUDA device that torch can still hand out, within the limit of `limit_memory`."""
    import torch

    held = torch.cuda.memory_allocated(device)
    free = torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device) - held
    limit = _LIMITS.get({}).get("cuda")
    return free if limit is None else max(min(free, int(limit) - held), 0)


def keeps_more_than(share: float, device: torch.device) -> bool:
    """Whether torch keeps more than this share of a device's memory for later, unused; nothing on a CPU."""
    import torch

    if device.type != "cuda":
        return False
    unused = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return unused > share * torch.cuda.mem_get_info(device)[1]


def give_back() -> None:
    """Give back what torch keeps of GPUs for later."""
    import torch

    with recording:
        torch.cuda.empty_cache()


def available_memory() -> int | None:
    """Bytes of memory that a process may still take, or None where the system does not say.

    Within the limit of `limit_memory`, of which what the process holds already is taken off.
    """
    free = []
    if (limit := _LIMITS.get({}).get("cpu")) is not None:
        free.append(max(int(limit) - _held(), 0))
    with suppress(OSError):
        for line in _MEMINFO.read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                free.append(int(line.split()[1]) * 1024)
    with suppress(OSError):
        for folder, names in _groups(_OWN_GROUPS.read_text(encoding="utf-8"), _GROUPS):
            free += _left_in(folder, *names, min(free, default=_NO_LIMIT))
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
    where, remedy = f"the {in_gigabytes(there)} of memory that are free", remedies[worst]
    limit = _LIMITS.get({}).get("cpu")
    if limit is not None and total > limit - _held():
        where = f"the {in_gigabytes(there)} that settings['memory'] leaves beside what the process holds"
        remedy = f"raise settings['memory'], or {remedy}"
    parts = ", ".join(
        f"{words} {in_gigabytes(size)}" for words, size in needed.values() if size > 0.01 * total
    )
    raise fail(
        worst,
        f"what fits into {where}",
        f"about {in_gigabytes(total)} ({parts})",
        remedy,
        MemoryError,
    )


def in_gigabytes(size: float) -> str:
    """Bytes as text: in GB, or in MB where that is less than a tenth."""
    return f"{size / 1e9:.2f} GB" if size >= 1e8 else f"{size / 1e6:.3g} MB"


def _held() -> int:
    """Bytes of memory that this process holds; 0 where the system does not say."""
    with suppress(OSError):
        return int(_STATM.read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0


# Asked for every picture of a folder.
@functools.lru_cache(maxsize=4)
def _groups(own_groups: str, groups: Path) -> list[tuple[Path, tuple[str, str, str]]]:
    """Folders of the control groups of a process that may limit its memory, and of those around them."""
    found = []
    for line in own_groups.splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers in ("", "memory"):
            root = groups / controllers
            own = root / path.lstrip("/")
            # Inside a container the path may be that outside of it, and its own group is the root.
            around = [folder for folder in (own, *own.parents) if folder == root or root in folder.parents]
            found += [(folder, _VERSIONS[controllers]) for folder in around]
    return found


def _left_in(folder: Path, limit: str, usage: str, files: str, least: float) -> list[int]:
    """Bytes left in a group that has a limit, where they may be less than the ``least`` found so far."""
    with suppress(OSError, ValueError):  # "max" is no number, and no limit
        most = int((folder / limit).read_text(encoding="ascii"))
        if most >= _NO_LIMIT:
            return []
        taken = int((folder / usage).read_text(encoding="ascii"))
        if most - taken >= least:
            return []
        stat = (folder / "memory.stat").read_text(encoding="ascii").splitlines()
        spare = sum(int(line.split()[1]) for line in stat if line.startswith(files))
        return [max(most - taken + spare, 0)]
    return []
