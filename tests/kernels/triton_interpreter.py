"""Cases of the Triton kernels in Triton's interpreter on the CPU."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest


def interpret(names) -> dict[str, str]:
    """Traceback by name of every one of these cases that fails in the interpreter.

    Triton decides when it is imported whether it interprets, so that is done in a process of its own.
    """
    if importlib.util.find_spec("triton") is None:
        pytest.skip("triton is not installed")
    environment = {**os.environ, "TRITON_INTERPRET": "1", "CUDA_VISIBLE_DEVICES": ""}
    script = Path(__file__).with_name("triton_cases.py")
    done = subprocess.run(
        [sys.executable, script, *names], env=environment, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
