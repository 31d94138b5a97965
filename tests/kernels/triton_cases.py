"""Checks of the Triton kernels that run on a GPU and, tiny, in Triton's interpreter on a CPU.

``python triton_cases.py`` with ``TRITON_INTERPRET=1`` runs every case on the CPU and prints what went
wrong, as JSON.
"""

import json
import sys
import traceback

import numpy as np
import torch
import triton_image_cases  # noqa: F401 - adds to CASES
import triton_step_cases  # noqa: F401
from triton_case import CASES


def poison() -> None:
    """Make uninitialised tensors begin as NaN, or as a large integer, so that an unwritten element shows."""
    for name in ("empty", "empty_like"):
        setattr(torch, name, _poisoned(getattr(torch, name)))
    torch.Tensor.new_empty = _poisoned(torch.Tensor.new_empty)


def _poisoned(allocate):
    def wrapper(*args, **kwargs):
        tensor = allocate(*args, **kwargs)
        return tensor.fill_(float("nan") if tensor.is_floating_point() else 1 << 30)

    return wrapper


def main() -> None:
    poison()
    np.seterr(all="ignore")  # the interpreter computes masked lanes too
    problems = {}
    for name, function in CASES.items():
        try:
            function("cpu")
        except Exception:  # of any kind: its traceback goes to the test of that case, which fails with it
            problems[name] = traceback.format_exc()
    json.dump(problems, sys.stdout)


if __name__ == "__main__":
    main()
