"""Which implementation of the kernels runs, and why.

An implementation that can run has also shown it: a tiny projection is compared with the reference once a process.
"""

from __future__ import annotations

import functools
import logging

import numpy as np
import torch

from tomo_polysplat.checks import fail
from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["KERNELS", "availability", "choose", "describe"]

logger = logging.getLogger(__name__)

KERNELS = ("triton", "numba", "reference")
_SELF_CHECK_TOLERANCE = 1e-4


def choose(device: torch.device, requested: str = "auto") -> tuple[str, str]:
    """The kernel for a device and the reason: ``("numba", "...")``.

    Raises
    ------
    ValueError
        If ``requested`` is unknown or cannot run on the device.
    """
    if requested not in ("auto", *KERNELS):
        raise fail("kernel", f"auto or one of {', '.join(KERNELS)}", repr(requested))
    if requested != "auto":
        usable, reason = availability(requested, device.type)
        if not usable:
            raise fail(
                "kernel", f"a kernel that runs on {device}", f"{requested!r} ({reason})", "use kernel='auto'"
            )
        return requested, "asked for"
    refused: list[str] = []
    for name in KERNELS:
        usable, reason = availability(name, device.type)
        if usable:
            return name, "; ".join([reason, *refused])
        refused.append(f"not {name}: {reason}")
    raise RuntimeError("; ".join(refused))


def describe() -> list[tuple[str, str, bool, str]]:
    """(kernel, device type, usable, reason) of every combination worth telling."""
    pairs = [("triton", "cuda"), ("numba", "cpu"), ("reference", "cpu"), ("reference", "cuda")]
    return [(name, device, *availability(name, device)) for name, device in pairs]


@functools.cache
def availability(name: str, device_type: str) -> tuple[bool, str]:
    """Whether a kernel runs on a kind of device ("cpu", "cuda"), found by running it, and why (not)."""
    if device_type == "cuda" and not torch.cuda.is_available():
        return False, "torch finds no CUDA device"
    if name == "reference":
        return True, "plain torch, slow"
    wanted = {"triton": "cuda", "numba": "cpu"}[name]
    if device_type != wanted:
        return False, f"runs on {wanted} only"
    try:
        error = _self_check(name, device_type)
    except Exception as problem:  # a broken compiler or driver can raise anything; it must not end the run
        logger.debug("self-check of %s failed", name, exc_info=True)
        message = f"{type(problem).__name__}: {problem}".splitlines()[0]
        return False, f"self-check raised {message[:150].rstrip(' :')}"
    if not error < _SELF_CHECK_TOLERANCE:
        return False, f"self-check differs from the reference by {error:.1e}"
    return True, f"compiled, self-check within {error:.0e} of the reference"


def _self_check(name: str, device_type: str) -> float:
    """Largest relative difference of images and gradients to the reference on five Gaussians."""
    from tomo_polysplat.kernels.project.autograd import project

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
    for kernel, device, dtype in (("reference", "cpu", torch.float64), (name, device_type, torch.float32)):
        inputs = [t.to(device, dtype).requires_grad_() for t in scene]
        position, scale, rotation, weight = inputs
        image, _ = project(position, scale, rotation, weight, views, kernel=kernel, cutoff=3.0)
        (image * target.to(device, dtype)).sum().backward()
        results = [image, *(t.grad for t in inputs if t.grad is not None)]
        outcomes.append([t.detach().cpu().double() for t in results])
    return max(float((a - b).norm() / a.norm()) for a, b in zip(*outcomes))
