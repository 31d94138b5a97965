"""Derivatives by one number."""

from __future__ import annotations

from collections.abc import Callable

import torch

__all__ = ["slope_at_zero"]


@torch.enable_grad()
def slope_at_zero(function: Callable[[torch.Tensor], torch.Tensor]) -> torch.Tensor:
    """Derivative at 0 of a tensor by a float64 number, shaped like the tensor: the gradient of a gradient's slope.

    It is ``torch.autograd.functional.jvp`` but for what that imports, sympy, which takes more than a second.
    """
    step = torch.zeros((), dtype=torch.float64, requires_grad=True)
    values = function(step)
    weight = torch.zeros_like(values, requires_grad=True)
    told = (values * weight).sum()
    weighted = torch.autograd.grad(told, step, create_graph=True, allow_unused=True)[0]
    if weighted is None:  # the number changes nothing
        return torch.zeros_like(values)
    slope: torch.Tensor = torch.autograd.grad(weighted, weight)[0]
    return slope
