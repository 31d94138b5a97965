"""The polychromatic projection of base-material line integrals, differentiable in PyTorch."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch

from tomo_polysplat.checks import fail
from tomo_polysplat.kernels.device import is_for_compiled
from tomo_polysplat.physics.quadrature import Quadrature

__all__ = ["nodes_on", "polychromatic_projection"]


def polychromatic_projection(
    areal: torch.Tensor, quadrature: Quadrature, behind: torch.Tensor | None = None
) -> torch.Tensor:
    r"""Projection values of rays from their areal densities.

    .. math:: P = -\log \sum_n w_n \exp(-\sum_k a_k b_{kn}), \qquad
       \partial P / \partial a_k = \sum_n s_n b_{kn}, \quad s = \mathrm{softmax}(\log w - a \cdot b)

    Differentiable once, by that formula. Stable in float32 for opaque rays (the largest exponent is taken out
    of the sum) and finite for negative ``areal``.

    Parameters
    ----------
    areal : (3, ...) float32 or float64 tensor
        Areal densities in g/cm2 of the soft, middle and dense material along each ray; (1, ...) for nodes of
        the soft one alone.
    quadrature : Quadrature
        Nodes of the detected spectrum.
    behind : (...) tensor, optional
        Areal densities in g/cm2 of the filter that the nodes know, in a shape that goes with that of the rays.

    Returns
    -------
    (...) tensor
        ``P = -log(I / I0)``, in the type and on the device of ``areal``.

    Raises
    ------
    ValueError
        If the first axis is not that of the nodes, or the type is not floating point.
    """
    _require_channels(tuple(areal.shape), quadrature)
    if areal.dtype not in (torch.float32, torch.float64):
        raise fail("areal", "float32 or float64", f"{areal.dtype}")
    log_weights, attenuation = nodes_on(quadrature, areal.dtype, areal.device)
    if behind is not None:
        assert quadrature.filter is not None
        taken = torch.tensor(quadrature.filter[:, None], dtype=areal.dtype, device=areal.device)
        log_weights = log_weights - taken * behind.expand(areal.shape[1:]).reshape(1, -1)
    return _Projection.apply(areal, log_weights, attenuation)


def _require_channels(shape: tuple[int, ...], quadrature: Quadrature) -> None:
    channels = len(quadrature.attenuation)
    if shape[:1] != (channels,):
        raise fail("areal", f"shape ({channels}, ...), one channel per base material", f"{shape}")


@lru_cache(maxsize=16)
def nodes_on(
    quadrature: Quadrature, dtype: torch.dtype, device: torch.device
) -> tuple[torch.Tensor, torch.Tensor]:
    """Log weights ``(n, 1)`` and attenuation ``(n, 3)`` or ``(n, 1)`` where they are needed, copied there once."""
    log_weights = torch.tensor(quadrature.log_weights[:, None], dtype=dtype, device=device)
    return log_weights, torch.tensor(quadrature.attenuation.T.copy(), dtype=dtype, device=device)


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, areal: torch.Tensor, log_weights: torch.Tensor, attenuation: torch.Tensor
    ) -> torch.Tensor:
        ctx.compiled = is_for_compiled(areal)
        if ctx.compiled:
            from tomo_polysplat.kernels.step.numba_beer_lambert import beer_lambert

            rays = areal.reshape(len(areal), -1)
            value, slopes = beer_lambert(rays, log_weights, attenuation, ctx.needs_input_grad[0])
            ctx.save_for_backward(slopes)
            return value.reshape(areal.shape[1:])
        value = torch.logsumexp(_exponents(areal, log_weights, attenuation), dim=0)
        ctx.save_for_backward(areal, log_weights, attenuation, value)
        return -value.reshape(areal.shape[1:])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        if ctx.compiled:
            (slopes,) = ctx.saved_tensors
            return (slopes * gradient.reshape(1, -1)).reshape(-1, *gradient.shape), None, None
        areal, log_weights, attenuation, value = ctx.saved_tensors
        # Recomputed rather than kept: the exponents take as many times the memory of P as there are nodes.
        share = _exponents(areal, log_weights, attenuation).sub_(value).exp_()
        mean = torch.stack([(share * curve[:, None]).sum(dim=0) for curve in attenuation.unbind(1)])
        return (mean * gradient.reshape(1, -1)).reshape(areal.shape), None, None


def _exponents(areal: torch.Tensor, log_weights: torch.Tensor, attenuation: torch.Tensor) -> torch.Tensor:
    """``(nodes, rays)``. No matrix product: reduced-precision ones (TF32, autocast) would cost 1e-3 of P."""
    exponents = log_weights
    for path, curve in zip(areal.reshape(len(areal), -1), attenuation.unbind(1)):
        exponents = torch.addcmul(exponents, curve[:, None], path, value=-1.0)
    return exponents
