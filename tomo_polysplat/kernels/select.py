"""Which implementation of the kernels runs, and why.

An implementation that can run has also shown it: a tiny projection is compared with the reference once a process.
"""

from __future__ import annotations

import functools
import logging

import numpy as np
import torch

from tomo_polysplat.checks import fail
from tomo_polysplat.kernels.ahead import wait_for_kernels
from tomo_polysplat.kernels.device import pick_device
from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["KERNELS", "availability", "choose", "describe", "pick_fast_device"]

logger = logging.getLogger(__name__)

KERNELS = ("triton", "numba", "reference")
_SELF_CHECK_TOLERANCE = 1e-4


def choose(device: torch.device, requested: str = "auto") -> tuple[str, str]:
    """The kernel for a device and the reason: ``("numba", "...")``.

    Raises
    ------
    ValueError
        If ``requested`` is unknown or cannot run on the device.
    RuntimeError
        If none that is made for a GPU runs on it: with the reference, work of seconds would take hours there.
    """
    if requested not in ("auto", *KERNELS):
        raise fail("kernel", f"auto or one of {', '.join(KERNELS)}", repr(requested))
    if requested != "auto":
        usable, reason = availability(requested, str(device))
        if not usable:
            raise fail(
                "kernel", f"a kernel that runs on {device}", f"{requested!r} ({reason})", "use kernel='auto'"
            )
        return requested, "asked for"
    refused: list[str] = []
    for name in KERNELS[:-1]:
        usable, reason = availability(name, str(device))
        if usable:
            return name, "; ".join([reason, *refused])
        refused.append(f"not {name}: {reason}")
    words = "; ".join(refused)
    if device.type == "cuda":
        remedy = "use device='cpu', or settings={'kernel': 'reference'}, which is slow"
        got = f"{device} ({words})"
        raise fail("device", "a GPU that compiled kernels run on", got, remedy, RuntimeError)
    logger.warning("No compiled kernel runs here (%s): the reference does, which is far slower.", words)
    return KERNELS[-1], "; ".join([availability(KERNELS[-1], str(device))[1], *refused])


def pick_fast_device(name: str | torch.device) -> torch.device:
    """The device of a name, as `pick_device`; ``"auto"`` is a GPU only where a compiled kernel runs on it."""
    device = pick_device(name)
    if name == "auto" and device.type == "cuda":
        usable, reason = availability("triton", str(device))
        if not usable:
            logger.warning("The GPU is not used: no compiled kernel runs on it (triton: %s).", reason)
            return torch.device("cpu")
    return device


def describe() -> list[tuple[str, str, bool, str]]:
    """(kernel, device type, usable, reason) of every combination worth telling."""
    pairs = [("triton", "cuda"), ("numba", "cpu"), ("reference", "cpu"), ("reference", "cuda")]
    return [(name, device, *availability(name, device)) for name, device in pairs]


def availability(name: str, device: str) -> tuple[bool, str]:
    """Whether a kernel runs on a device ("cpu", "cuda", "cuda:1"), found by running it, and why (not)."""
    device_type = torch.device(device).type
    if device_type == "cuda" and not torch.cuda.is_available():
        return False, "torch finds no CUDA device"
    if name == "reference":
        return True, "plain torch, slow"
    wanted = {"triton": "cuda", "numba": "cpu"}[name]
    if device_type != wanted:
        return False, f"runs on {wanted} only"
    try:
        error = _self_check(name, device)
    except Exception as problem:  # a broken compiler or driver can raise anything; it must not end the run
        logger.debug("self-check of %s failed", name, exc_info=True)
        message = f"{type(problem).__name__}: {problem}".splitlines()[0]
        return False, f"self-check raised {message[:150].rstrip(' :')}"
    if not error < _SELF_CHECK_TOLERANCE:
        return False, f"self-check differs from the reference by {error:.1e}"
    return True, f"compiled, self-check within {error:.0e} of the reference"


# What raises is tried again: a GPU that was full is not so for ever.
@functools.cache
def _self_check(name: str, device: str) -> float:
    """Largest relative difference of images and gradients to the reference on five Gaussians."""
    from tomo_polysplat.kernels.project.autograd import project

    if name == "numba":
        wait_for_kernels()
    direction = np.array([0.0, 3.0, 0.0]) - 0.1 * np.array([6.0, 0.0, 4.0])
    matrix = np.stack([[0.1, 0, 0], [0, 0, 0.1], direction], axis=1)[None]
    views = DetectorViews(True, np.array([[0.0, -2.0, 0.0]]), matrix, 9, 13)
    generator = torch.Generator().manual_seed(0)
    scene = [
        torch.rand((5, 3), generator=generator) - 0.5,
        torch.rand((5, 3), generator=generator) * 0.1 + 0.05,
        torch.randn((5, 4), generator=generator),
        torch.rand((3, 5), generator=generator),
    ]
    target = torch.rand((3, 1, 9, 13), generator=generator)
    outcomes = []
    for kernel, place, dtype in (("reference", "cpu", torch.float64), (name, device, torch.float32)):
        inputs = [t.to(place, dtype).requires_grad_() for t in scene]
        position, scale, rotation, weight = inputs
        image, _ = project(position, scale, rotation, weight, views, kernel=kernel, cutoff=3.0)
        (image * target.to(place, dtype)).sum().backward()
        results = [image, *(t.grad for t in inputs if t.grad is not None)]
        outcomes.append([t.detach().cpu().double() for t in results])
    return max(float((a - b).norm() / a.norm()) for a, b in zip(*outcomes))
