"""The derivative of a function of one number."""

from __future__ import annotations

from collections.abc import Callable

import torch

__all__ = ["slope_at_zero"]


@torch.enable_grad()
def slope_at_zero(function: Callable[[torch.Tensor], torch.Tensor]) -> torch.Tensor:
    """Derivative of a tensor by a number in float64, at 0.

    Backwards twice, as ``torch.autograd.functional.jvp`` goes; that imports SymPy, which takes half a second.
    """
    step = torch.zeros((), dtype=torch.float64, requires_grad=True)
    value = function(step)
    if not value.requires_grad:
        return torch.zeros_like(value)
    weight = torch.zeros_like(value, requires_grad=True)
    by_step = torch.autograd.grad((value * weight).sum(), step, create_graph=True)[0]
    return torch.autograd.grad(by_step, weight)[0]
