"""What a measured time depends on besides the code: machine, versions, commit."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path
from typing import Any

from tomo_polysplat.parallel import cpu_threads
from tomo_polysplat.versions import installed_version

__all__ = ["environment"]

_PACKAGES = ("tomo-polysplat", "numpy", "torch", "numba", "triton", "astra-toolbox", "mbirtorch")


def environment() -> dict[str, Any]:
    """JSON-able: ``cpu``, ``threads``, ``load`` (of one minute), ``gpus``, ``system``, ``versions``, ``commit``."""
    import torch

    return {
        "cpu": _cpu(),
        "threads": cpu_threads(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "gpus": [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())],
        "system": platform.platform(),
        "versions": {
            "python": platform.python_version(),
            "cuda": torch.version.cuda,
            **{name: installed_version(name) for name in _PACKAGES},
        },
        "commit": _commit(),
    }


def _cpu() -> str:
    description = Path("/proc/cpuinfo")
    if description.is_file():
        for line in description.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _commit() -> str | None:
    """The commit, with ``-dirty`` when files differ from it; None outside a checkout of this package."""
    here = Path(__file__)

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(here.parent), *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True, timeout=10).stdout.strip()

    try:
        # An installed package may lie in a folder of somebody else's repository.
        git("ls-files", "--error-unmatch", here.name)
        return git("describe", "--always", "--dirty", "--exclude", "*")
    except (OSError, subprocess.SubprocessError):
        return None
