"""The fast implementations under test, and memory that is poisoned before they write to it."""

import numpy as np
import pytest
import torch

from tomo_polysplat.kernels import select


@pytest.fixture(params=["numba", pytest.param("triton", marks=pytest.mark.gpu)])
def fast(request) -> tuple[str, str]:
    """(kernel, device type) of every implementation that is not the reference."""
    kernel = request.param
    device = "cuda" if kernel == "triton" else "cpu"
    usable, reason = select.availability(kernel, device)
    assert usable, reason
    return kernel, device


@pytest.fixture
def poison_empty(fast, monkeypatch):
    """Uninitialised arrays begin as NaN, or as a large integer, so that an unwritten element shows.

    ``fast`` has compiled the kernels before; compiled code keeps the true allocator.
    """

    def poisoned_array(allocate):
        def wrapper(*args, **kwargs):
            array = allocate(*args, **kwargs)
            array.fill(np.nan if array.dtype.kind == "f" else 1 << 30)
            return array

        return wrapper

    def poisoned_tensor(allocate):
        def wrapper(*args, **kwargs):
            tensor = allocate(*args, **kwargs)
            return tensor.fill_(float("nan") if tensor.is_floating_point() else 1 << 30)

        return wrapper

    for name in ("empty", "empty_like"):
        monkeypatch.setattr(np, name, poisoned_array(getattr(np, name)))
        monkeypatch.setattr(torch, name, poisoned_tensor(getattr(torch, name)))
