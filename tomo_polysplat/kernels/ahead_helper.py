"""What the process does that compiles kernels ahead (``ahead``)."""

from __future__ import annotations

import os
import sys
import threading

from tomo_polysplat.kernels.ahead import STOP, compile_voxelise
from tomo_polysplat.quiet_imports import ending_quickly

__all__ = ["main"]


def main() -> None:
    """Compile the projection, and the volume unless told to stop; end at once when the other process does."""
    ending_quickly()
    stopped = threading.Event()

    def listen() -> None:
        while heard := os.read(sys.stdin.fileno(), 1):
            if heard == STOP:
                stopped.set()
        os._exit(1)

    threading.Thread(target=listen, daemon=True).start()
    # Imported last: to load torch takes seconds, in which the other process may end.
    from tomo_polysplat.kernels.select import availability

    availability("numba", "cpu")
    if not stopped.is_set():
        compile_voxelise()
