"""The CPU kernels, compiled by a second process while this one still reads or simulates its scan.

Numba compiles one function at a time in a process, and keeps on disk what it has compiled. So a helper compiles into
that cache, on another core, and this process loads from it.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from tomo_polysplat.kernels.compile_time import add_waited
from tomo_polysplat.parallel import cpu_threads

__all__ = ["STOP", "compile_voxelise", "compiled_ahead", "wait_for_kernels"]

logger = logging.getLogger(__name__)

STOP = b"."  # tells the helper to begin nothing more
_START = "import sys; sys.path[:] = {0!r}; from tomo_polysplat.kernels.ahead_helper import main; main()"
# Seconds to wait for a helper, which takes 10 on an idle core: one that hangs is given up.
_LONGEST = 120.0
_helper: subprocess.Popen[bytes] | None = None


@contextmanager
def compiled_ahead(device: str) -> Iterator[None]:
    """Have the kernels compiled by another process, where they are not on disk and a core is free.

    It writes nothing to the terminal, ends with this process or at the end of the context, and where it fails this
    process compiles as it would have.

    Parameters
    ----------
    device : str
        The argument of the reconstruction that follows: only the CPU's kernels are compiled ahead.
    """
    global _helper
    if _helper is None:
        try:
            _helper = _started(device)
        except Exception:  # whatever a machine lacks, it is no reason to do without the reconstruction
            logger.debug("Kernels are not compiled ahead", exc_info=True)
    try:
        yield
    finally:
        helper, _helper = _helper, None
        _end(helper)


def wait_for_kernels() -> None:
    """Return when the helper has compiled all it was to compile, or has failed; compile what it has not begun."""
    global _helper
    helper, _helper = _helper, None
    if helper is None:
        return
    try:
        if not _compiled_project():
            _tell(helper, STOP)
            compile_voxelise()
        begun = time.perf_counter()
        with suppress(subprocess.TimeoutExpired):
            helper.wait(_LONGEST)
        add_waited(time.perf_counter() - begun)
    finally:
        _end(helper)


def compile_voxelise() -> None:
    """Compile the kernels between Gaussians and voxels, or load them."""
    from tomo_polysplat.kernels.voxelise import numba_kernel
    from tomo_polysplat.kernels.voxelise.box import VoxelBox

    box = VoxelBox(np.full(3, -0.5), np.ones(3), (2, 2, 2))
    position, scale, rotation, weight = (np.ones((1, n), np.float32) for n in (3, 3, 4, 1))
    volume = numba_kernel.forward(position, scale, rotation, weight, box, 3.0)
    numba_kernel.backward(position, scale, rotation, weight, box, 3.0, volume)


def _started(device: str) -> subprocess.Popen[bytes] | None:
    from tomo_polysplat.kernels.device import pick_device

    if cpu_threads() == 1 or not sys.executable or pick_device(device).type != "cpu" or _compiled_project():
        return None
    return subprocess.Popen(
        [sys.executable, "-c", _START.format(sys.path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )


def _tell(helper: subprocess.Popen[bytes], word: bytes) -> None:
    assert helper.stdin is not None
    with suppress(OSError):  # it has ended
        helper.stdin.write(word)
        helper.stdin.flush()


def _end(helper: subprocess.Popen[bytes] | None) -> None:
    if helper is not None:
        helper.kill()
        helper.communicate()


def _compiled_project() -> bool:
    """Whether the kernel of this part that is compiled last is on disk, in the form of today's source."""
    from tomo_polysplat.kernels.project import numba_kernel

    # Numba has no public question for that; one without these names raises, and nothing is compiled ahead.
    function: Any = numba_kernel._gather_range
    return bool(function._cache._cache_file._load_index())
