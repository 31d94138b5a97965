"""One process at a time for a file that a run comes back to."""

from __future__ import annotations

import errno
import logging
import os
from contextlib import suppress
from pathlib import Path

from tomo_polysplat.checks import fail

__all__ = ["FileLock"]

logger = logging.getLogger(__name__)

_TAKEN = (errno.EACCES, errno.EAGAIN)
# Of this process by name: the open file and how many use it. Closing any file of that name would give up the lock.
_held: dict[Path, list[int]] = {}


class FileLock:
    """The right to write a file, kept until `release` or the end of the process, however that ends.

    A file ``.NAME.lock`` beside it is locked by the system. Where the system or the file system has no locks
    there is none, and nothing is refused. The same process may take it more than once.

    Parameters
    ----------
    path : path
        The file.
    argument : str
        Name of the argument for the error.

    Raises
    ------
    BlockingIOError
        If another process has it.
    """

    def __init__(self, path: Path, argument: str = "path") -> None:
        target = path.resolve()
        self._name = target.with_name(f".{target.name[:40]}.lock")
        self._owner: int | None = None
        while not self._settled(argument, path):
            pass

    def _settled(self, argument: str, path: Path) -> bool:
        """Whether it is known who has it; else another process has just removed the file that was locked."""
        try:
            import fcntl
        except ImportError:
            return True
        if self._name in _held:
            _held[self._name][1] += 1
            self._owner = os.getpid()
            return True
        # A link of this name, in a folder that others write to, is not followed.
        file = os.open(self._name, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(file)
            if error.errno not in _TAKEN:
                logger.debug("No lock on %s: %s", path, error)
                return True
            got, remedy = f"{path}, which another run writes", "wait for it, or name another file"
            raise fail(argument, "a file of this run", got, remedy, BlockingIOError) from None
        if not _is_at(file, self._name):
            os.close(file)
            return False
        _held[self._name] = [file, 1]
        self._owner = os.getpid()
        return True

    def release(self) -> None:
        """Let others have it; called again it does nothing."""
        owner, self._owner = self._owner, None
        # A fork has the object but not the lock.
        if owner != os.getpid():
            return
        held = _held[self._name]
        held[1] -= 1
        if not held[1]:
            # Removed first: nobody is to lock a file that is about to go.
            with suppress(OSError):
                os.unlink(self._name)
            os.close(_held.pop(self._name)[0])

    def __del__(self) -> None:
        if getattr(self, "_owner", None) is not None:
            self.release()


def _is_at(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), os.stat(path))
    except FileNotFoundError:
        return False
