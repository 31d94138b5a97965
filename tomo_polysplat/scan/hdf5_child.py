"""Parts of HDF5 datasets and attributes that are read in a process of its own.

The unpackers of the many filters trust what they unpack, and so does HDF5 with texts: of a damaged file they may
take any memory, never return, or end the process. This one may end without harm; its memory and time are bounded
by what it has to give.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping
from contextlib import suppress
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail

if TYPE_CHECKING:
    import h5py

    from tomo_polysplat.scan.hdf5_chunks import Box

__all__ = ["main", "read_apart", "text_apart"]

# Of the clock, of the CPU, and bytes in a second of the CPU: slow unpackers give a hundred MB.
_SECONDS, _CPU_SECONDS, _BYTES_PER_SECOND = 60.0, 4, 2e7
_SPARE_BYTES = 2**29
_LONGEST_TEXT = 2**16
_START = "import sys; sys.path[:] = {0!r}; from tomo_polysplat.scan.hdf5_child import main; main()"
_REMEDY = (
    "python -m pip install 'tomo-polysplat[hdf5]' adds filters; if they are there, the file is damaged: "
    "copy or write it again"
)


def read_apart(dataset: h5py.Dataset, box: Box, where: str) -> np.ndarray:
    """A part of a dataset, which errors call ``where``.

    Raises
    ------
    ValueError
        If the process ends, or takes longer or more memory than this part may need.
    """
    out = np.empty([len(part) for part in box], dataset.dtype)
    chunk = math.prod(dataset.chunks or (1,)) * dataset.dtype.itemsize
    task = {
        "file": dataset.file.filename,
        "name": dataset.name,
        "box": [[part.start, part.stop, part.step] for part in box],
        "dtype": dataset.dtype.str,
        "memory": 2 * out.nbytes + 4 * chunk,
    }
    _ask(task, out, where)
    return out


def text_apart(file: str, name: str, attribute: str, where: str) -> str:
    """An attribute that is a text of at most 64 KiB."""
    out = np.zeros(_LONGEST_TEXT, np.uint8)
    _ask({"file": file, "name": name, "attribute": attribute, "memory": _LONGEST_TEXT}, out, where)
    return out.tobytes().rstrip(b"\0").decode("utf-8", "replace")


def _ask(task: Mapping[str, Any], out: np.ndarray, where: str) -> None:
    """Fill `out` with the bytes that the process gives."""
    seconds = _CPU_SECONDS + int(out.nbytes / _BYTES_PER_SECOND)
    with (
        tempfile.TemporaryFile() as said,
        subprocess.Popen(
            [sys.executable, "-I", "-c", _START.format(sys.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=said,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        ) as process,
    ):
        assert process.stdin is not None and process.stdout is not None
        watch = threading.Timer(_SECONDS + 10 * seconds, process.kill)
        watch.start()
        try:
            with suppress(BrokenPipeError):
                process.stdin.write(json.dumps({**task, "seconds": seconds}).encode())
                process.stdin.close()
            complete = _fill(process.stdout, out)
            status = process.wait()
        finally:
            watch.cancel()
            process.kill()
        if not complete or status != 0:
            said.seek(0)
            why = said.read(2**16).decode("utf-8", "replace").strip().rsplit("\n", 1)[-1]
            raise fail(where, "data that can be unpacked", why or f"a crash (status {status})", _REMEDY)


def _fill(stream: IO[bytes], out: np.ndarray) -> bool:
    view = memoryview(out.reshape(-1).view(np.uint8).data)
    done = 0
    while done < len(view):
        got = stream.readinto(view[done:])  # type: ignore[attr-defined]
        if not got:
            return False
        done += got
    return True


def main() -> None:
    """The other process: a task from the standard input, its bytes to the standard output."""
    import h5py

    with suppress(ImportError):
        import hdf5plugin  # noqa: F401  # adds its filters to HDF5
    task = json.loads(sys.stdin.buffer.read())
    _limit(task["memory"], task["seconds"])
    try:
        with h5py.File(task["file"], "r") as file:
            item = file[task["name"]]
            if "attribute" in task:
                value = item.attrs[task["attribute"]]
                value = value.reshape(-1)[0] if isinstance(value, np.ndarray) else value
                text = value if isinstance(value, bytes) else str(value).encode("utf-8", "replace")
                content = text[:_LONGEST_TEXT].ljust(_LONGEST_TEXT, b"\0")
            else:
                part = item[tuple(slice(*axis) for axis in task["box"])]
                content = np.ascontiguousarray(part, task["dtype"]).tobytes()
            sys.stdout.buffer.write(content)
    except (Exception, MemoryError) as error:
        sys.exit(f"{type(error).__name__}: {error}"[:1000].replace("\n", " "))


def _limit(memory: int, seconds: int) -> None:
    """Bound what this process takes from now on, where the system can."""
    try:
        import resource
    except ImportError:
        return
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
        with open("/proc/self/statm", encoding="ascii") as file:
            taken = int(file.read().split()[0]) * resource.getpagesize()
        most = taken + memory + _SPARE_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
