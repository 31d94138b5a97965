"""The device that does the work, and torch's threads on it."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import numpy as np
import torch

from tomo_polysplat.checks import fail

__all__ = ["is_for_compiled", "one_torch_thread", "pick_device", "usual_modes"]


def pick_device(name: str | torch.device) -> torch.device:
    """The device of a name: ``"auto"``, ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.

    A GPU has its index, as that of a tensor on it has: what is kept for one is found by the other.

    Raises
    ------
    ValueError
        For another name, or a GPU that torch does not find.
    """
    known = "auto, cpu, cuda or cuda:N"
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError):
        raise fail("device", known, repr(name)) from None
    if device.type not in ("cpu", "cuda"):
        raise fail("device", known, repr(name))
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        found = f"torch finds {torch.cuda.device_count()} CUDA devices"
        raise fail("device", "a device that is there", repr(name), f"{found}: use device='auto'")
    if device.type == "cuda" and device.index is None:
        return torch.device("cuda", torch.cuda.current_device())
    return device


def is_for_compiled(values: torch.Tensor) -> bool:
    """Whether the parts of a step that are compiled for the CPU take these; what they do not take is torch's."""
    return values.device.type == "cpu" and values.dtype == torch.float32


class _Borrowed:
    """torch's number of threads while someone has lowered it; one for the process, as that number is."""

    def __init__(self) -> None:
        self.users, self.before = 0, 1
        self.renew_lock()

    def renew_lock(self) -> None:
        """A lock that nobody holds: after a fork the thread that held the old one is gone."""
        self.lock = threading.Lock()


_borrowed = _Borrowed()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_borrowed.renew_lock)


@contextmanager
def usual_modes() -> Iterator[None]:
    """torch and NumPy as they come, whatever modes the caller has chosen for work of its own.

    A call from within ``torch.no_grad()``, ``inference_mode()`` or ``autocast()``, or where NumPy raises at an
    underflow, gives the same result as any other, and so does one under another default device.
    """
    # Entered only where it is needed: torch asks it at every call.
    elsewhere = torch.get_default_device().type != "cpu"
    with (
        torch.device("cpu") if elsewhere else nullcontext(),
        torch.inference_mode(False),
        torch.enable_grad(),
        torch.autocast("cpu", enabled=False),
        torch.autocast("cuda", enabled=False),
        np.errstate(divide="warn", over="warn", under="ignore", invalid="warn"),
    ):
        yield


@contextmanager
def one_torch_thread(device: torch.device) -> Iterator[None]:
    """torch on one thread while a fit runs on the CPU.

    The tensors between the kernels are small: sharing them out costs more than it saves (a third of the time
    of a fit on two idle cores, and several times it on busy ones). Fits may overlap in several threads: each
    leaves behind the number that the first one found.
    """
    if device.type != "cpu":
        yield
        return
    with _borrowed.lock:
        if not _borrowed.users:
            _borrowed.before = torch.get_num_threads()
        _borrowed.users += 1
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _borrowed.lock:
            _borrowed.users -= 1
            torch.set_num_threads(_borrowed.before)
