"""Folders that appear whole: made under another name, they take their own at the end."""

from __future__ import annotations

import ctypes
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tomo_polysplat.checks import fail
from tomo_polysplat.files import (
    existing_parent,
    flush_to_disk,
    output_path,
    require_room,
    require_writable,
    temporary_beside,
)

__all__ = ["replacing_folder", "require_replaceable_folder"]

# What programs that only look at a folder leave in it.
_LITTER = (".DS_Store", "Thumbs.db", "desktop.ini")
# Linux: <linux/fs.h> and <fcntl.h>.
_EXCHANGE, _HERE = 2, -100


def require_replaceable_folder(
    folder: str | bytes | os.PathLike,
    ours: Callable[[Path], bool],
    *,
    overwrite: bool,
    remedy: str = "pass overwrite=True",
    argument: str = "folder",
    what: str = "slices",
) -> Path:
    """The folder that would be written; refused is one that holds, or is, what must stay.

    Parameters
    ----------
    folder : path
    ours : function of a path
        Whether a file in it is one of those that may be replaced.
    overwrite : bool
        Whether they are to be replaced.
    remedy, argument, what : str
        For the message of an error; `what` is in the folder.

    Raises
    ------
    FileExistsError
        If it holds files of ours and `overwrite` is false, or anything else.
    NotADirectoryError
        If it is a file.
    """
    target = output_path(folder, argument)
    if target.exists() and not target.is_dir():
        raise fail(argument, "a folder", f"the file {target}", error=NotADirectoryError)
    real, here = target.resolve(), Path.cwd()
    if real == here or real in here.parents:
        raise fail(argument, "a folder of its own", f"{target}, in which you are", "name a new folder")
    present = sorted(target.iterdir()) if target.is_dir() else []
    present = [path for path in present if path.name not in _LITTER]
    strange = [path for path in present if not ours(path)]
    if strange:
        got = f"{target} with {strange[0].name}" + (f" and {len(strange) - 1} more" if strange[1:] else "")
        choose = "name a new folder: this one is only ever replaced as a whole"
        raise fail(argument, f"a new folder, or one with nothing but {what}", got, choose, FileExistsError)
    if present and not overwrite:
        raise fail(argument, f"one without {what}", f"{len(present)} in {target}", remedy, FileExistsError)
    require_writable(existing_parent(target.parent), argument)
    return target


@contextmanager
def replacing_folder(
    folder: str | os.PathLike,
    ours: Callable[[Path], bool],
    *,
    overwrite: bool,
    needed_bytes: int = 0,
    what: str = "slices",
) -> Iterator[Path]:
    """An empty folder that becomes `folder` when the block ends without an error.

    On Linux the old folder and the new one change places in one step. Where the system or the file system
    cannot, the old one steps aside first; it is put back when the second step fails.

    Parameters
    ----------
    folder, ours, overwrite, what
        See :func:`require_replaceable_folder`, whose errors these are.
    needed_bytes : int
        Size to be written, compared with the free disk space before anything is written.
    """
    target = require_replaceable_folder(folder, ours, overwrite=overwrite, what=what).resolve()
    require_room(existing_parent(target.parent), needed_bytes)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_beside(target.with_suffix(""))
    temporary.mkdir()
    placed = False
    try:
        yield temporary
        for path in temporary.rglob("*"):
            if path.is_file():
                flush_to_disk(path)
        if target.exists():
            shutil.copymode(target, temporary)
        require_replaceable_folder(target, ours, overwrite=overwrite, what=what)
        _take_place(temporary, target)
        placed = True
    finally:
        if not placed:
            shutil.rmtree(temporary, ignore_errors=True)
    _clear(temporary, target, ours)


def _take_place(new: Path, target: Path) -> None:
    """Give `new` the name of `target`; what had that name is then called `new`, if there was anything."""
    if not target.exists():
        os.rename(new, target)
        return
    if _exchanged(new, target):
        return
    aside = temporary_beside(new)
    os.rename(target, aside)
    try:
        os.rename(new, target)
    except BaseException:
        os.rename(aside, target)
        raise
    os.rename(aside, new)


def _exchanged(one: Path, other: Path) -> bool:
    """Whether two folders have changed places in one step."""
    if not sys.platform.startswith("linux"):
        return False
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):
        return False
    return rename(_HERE, os.fsencode(one), _HERE, os.fsencode(other), ctypes.c_uint(_EXCHANGE)) == 0


def _clear(old: Path, target: Path, ours: Callable[[Path], bool]) -> None:
    """Remove the old folder; what somebody else has put into it in the meantime is brought along, or stays."""
    present = sorted(old.iterdir()) if old.is_dir() else []
    # Judged before anything is gone: what one file is may stand in another.
    removed = {path for path in present if ours(path) or path.name in _LITTER}
    for path in present:
        with suppress(OSError):
            if path in removed and path.is_dir():
                shutil.rmtree(path)
            elif path in removed:
                path.unlink()
            elif not (target / path.name).exists():
                os.rename(path, target / path.name)
    with suppress(OSError):
        old.rmdir()
