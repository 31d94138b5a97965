"""Writing files so that an interrupted run leaves the old or the new one, and reading them without trust."""

from __future__ import annotations

import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from tomo_polysplat.checks import fail
from tomo_polysplat.free_memory import available_memory

__all__ = [
    "existing_file",
    "existing_parent",
    "file_content",
    "flush_to_disk",
    "output_path",
    "replacing",
    "require_plausible_size",
    "require_replaceable",
    "require_room",
    "require_room_for",
    "require_writable",
    "temporary_beside",
    "write_text",
]

# Deflate, the strongest compression met in these formats, cannot shrink data by more than 1032.
LARGEST_COMPRESSION = 1100
# What a name may be long where the file system does not say; and the longest ending that a program goes by.
_LONGEST_NAME, _LONGEST_SUFFIX = 255, 12
# An array as it is read, in the order and type that are wanted, and at work.
_COPIES = 3
# Bytes that a process has to have anyway: the system is not asked about every small picture of a folder.
_SURELY = 1 << 20


@contextmanager
def replacing(path: str | os.PathLike, *, overwrite: bool, needed_bytes: int = 0) -> Iterator[Path]:
    """A temporary path in the folder of `path` that becomes `path` when the block ends without an error.

    Parameters
    ----------
    path : path
        The file to write; its folder must exist.
    overwrite : bool
        Whether an existing file may be replaced.
    needed_bytes : int
        Size to be written, compared with the free disk space before anything is written.

    Raises
    ------
    FileExistsError
        If the file exists and `overwrite` is false.
    OSError
        If the disk has too little free space.
    ValueError
        If no file can have this name.
    """
    target = require_replaceable(path, overwrite)
    require_room(target.parent, needed_bytes)
    temporary = temporary_beside(target)
    # With the usual permissions, which a temporary file of the library's does not have.
    temporary.touch(exist_ok=False)
    try:
        yield temporary
        flush_to_disk(temporary)
        if target.exists():
            shutil.copymode(target, temporary)
        require_replaceable(target, overwrite)
        os.replace(temporary, target)
    finally:
        with suppress(FileNotFoundError):
            temporary.unlink()


def temporary_beside(target: Path) -> Path:
    """A name that nobody can foresee, in the folder of `target` and with its ending, however long its own is."""
    suffix = target.suffix if len(target.suffix) <= _LONGEST_SUFFIX else ""
    return target.with_name(f".polysplat-{secrets.token_hex(8)}.part{suffix}")


def output_path(path: str | bytes | os.PathLike, argument: str = "path") -> Path:
    """Where a file of this name is written: a link is followed, so that it stays and its file is replaced.

    Raises
    ------
    ValueError
        If no file can have this name.
    FileNotFoundError
        For a link that leads nowhere.
    """
    name = os.fsdecode(path)
    if not name or "\0" in name:
        raise fail(argument, "the name of a file", repr(name), "choose another name")
    target = Path(name)
    _require_short(target, argument)
    if not target.is_symlink():
        return target
    # Followed by hand: a loop has no end to resolve to.
    real = Path(os.path.realpath(target))
    if not real.exists():
        remedy = "remove the link or make what it points to"
        raise fail(
            argument, "a file or a new name", f"{target}, a link to nothing", remedy, FileNotFoundError
        )
    return real


def _require_short(target: Path, argument: str) -> None:
    try:
        longest = os.pathconf(existing_parent(target.parent), "PC_NAME_MAX")
    except (AttributeError, OSError, ValueError):
        longest = _LONGEST_NAME
    if (size := max((len(os.fsencode(part)) for part in target.parts), default=0)) > longest:
        raise fail(argument, f"names of at most {longest} bytes", f"{size} bytes", "choose a shorter name")


def write_text(path: str | os.PathLike, text: str, *, overwrite: bool) -> None:
    """Write a file of text by `replacing`."""
    content = text.encode("utf-8", "replace")
    with replacing(path, overwrite=overwrite, needed_bytes=len(content)) as temporary:
        temporary.write_bytes(content)


def require_replaceable(
    path: str | bytes | os.PathLike,
    overwrite: bool,
    remedy: str = "pass overwrite=True",
    argument: str = "path",
) -> Path:
    """The file that would be written; refused are a folder, one in a missing folder, and one that must stay."""
    target = output_path(path, argument)
    if target.is_dir():
        raise fail(argument, "a file", f"the folder {target}", error=IsADirectoryError)
    if not target.parent.is_dir():
        raise fail(
            argument, "a file in an existing folder", str(target), "create the folder", FileNotFoundError
        )
    if target.exists() and not overwrite:
        raise fail(argument, "a new file", f"{target}, which exists", remedy, FileExistsError)
    if target.exists() and not target.is_file():
        raise fail(argument, "a file", f"{target}, a device or a pipe", "name a file")
    return target


def require_writable(folder: str | os.PathLike, argument: str = "path") -> None:
    """Refuse a folder in which no file can be made, by making one: permissions alone do not tell."""
    try:
        with tempfile.TemporaryFile(dir=Path(folder)):
            pass
    except OSError as error:
        remedy = "change its permissions or choose another folder"
        raise fail(
            argument, "a folder that can be written to", f"{folder} ({error})", remedy, type(error)
        ) from error


def flush_to_disk(path: Path) -> None:
    """Wait for the disk: a crash of the machine could else leave the new name with none of the new contents."""
    with open(path, "rb+") as file:
        os.fsync(file.fileno())


def require_room(folder: str | os.PathLike, needed_bytes: int) -> None:
    """Refuse to start writing what the disk cannot hold."""
    free = shutil.disk_usage(folder or ".").free
    if needed_bytes > free:
        raise fail(
            "path",
            f"{needed_bytes / 2**20:,.2f} MiB of free disk space",
            f"{free / 2**20:,.2f} MiB in {folder}",
            "free some space or choose another folder",
            OSError,
        )


def require_room_for(needed: Mapping[Path, int]) -> None:
    """Refuse work whose output, bytes by folder, the disks cannot hold; folders may share a disk."""
    shared: dict[int, tuple[Path, int]] = {}
    for folder, size in needed.items():
        there = existing_parent(folder)
        disk = there.stat().st_dev
        shared[disk] = (there, shared.get(disk, (there, 0))[1] + size)
    for there, size in shared.values():
        require_room(there, size)


def existing_parent(folder: Path) -> Path:
    """The folder, or the nearest one above it that exists."""
    return next(place for place in (folder, *folder.absolute().parents) if place.is_dir())


def require_plausible_size(name: str, declared_bytes: int, stored_bytes: int) -> None:
    """Refuse an array whose header promises more than the file or the memory can hold.

    A damaged or hostile header may declare any size, and memory would be taken before the first byte is read.
    """
    if declared_bytes > LARGEST_COMPRESSION * max(stored_bytes, 1):
        raise fail(
            name,
            "as much data as its header declares",
            f"{declared_bytes} bytes declared but {stored_bytes} stored",
            "the file is truncated or damaged: copy or write it again",
        )
    needed = _COPIES * declared_bytes
    memory = available_memory() if needed > _SURELY else None
    if memory is not None and needed > memory:
        raise fail(
            name,
            f"at most a third of the {memory / 2**30:.1f} GiB of free memory, which its copies need",
            f"{declared_bytes / 2**30:.1f} GiB",
            "bin or crop the data",
            MemoryError,
        )


def existing_file(path: str | os.PathLike, argument: str = "path") -> Path:
    """`path` as a Path to a file that exists and is not empty."""
    file = Path(path)
    if file.is_dir():
        remedy = "name a file in it; a scanner's folder becomes one file by `tomo-polysplat import`"
        raise fail(argument, "a file", f"{file}, which is a folder", remedy, FileNotFoundError)
    if not file.is_file():
        raise fail(argument, "an existing file", str(file), error=FileNotFoundError)
    if file.stat().st_size == 0:
        raise fail(argument, "a file with contents", f"{file}, which is empty")
    return file


def file_content(path: str | os.PathLike, most: int, argument: str = "path") -> bytes:
    """All of a small file, such as a text: a pipe would be waited for, and a large file is none of this kind.

    Raises
    ------
    FileNotFoundError
        If there is no such file, or something else in its place.
    ValueError
        If it is empty or has more than `most` bytes.
    """
    file = existing_file(path, argument)
    with open(file, "rb") as stream:
        content = stream.read(most + 1)
    if len(content) > most:
        raise fail(argument, f"a file of at most {most} bytes", f"{file.stat().st_size} in {file}")
    return content
