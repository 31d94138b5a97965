"""How what a ray measures changes with the filter in front of its pixel."""

from __future__ import annotations

import torch

from tomo_polysplat.physics.quadrature import Quadrature
from tomo_polysplat.physics.transmission import nodes_on

__all__ = ["filter_slope"]


def filter_slope(areal: torch.Tensor, quadrature: Quadrature, behind: torch.Tensor) -> torch.Tensor:
    r"""Derivative of ``-log(I / I0)`` by the filter's areal density, in cm2/g.

    The open beam passes the filter too, so it is what the filter takes from the light behind the object less what it
    takes from the open beam (`physics.filter_map`):

    .. math:: \partial P / \partial t = \sum_n (s_n(a, t) - s_n(0, t)) f_n, \quad
       s(a, t) = \mathrm{softmax}(\log w - a \cdot b - t f)

    0 without an object, and negative behind one: what is hard already is hardened less.

    Parameters
    ----------
    areal : (k, ..., rows, columns) tensor
        Areal densities in g/cm2 of the materials that the nodes know.
    quadrature : Quadrature
        Nodes that know a filter.
    behind : (rows, columns) tensor
        Areal density of it in g/cm2.
    """
    assert quadrature.filter is not None
    log_weights, attenuation = nodes_on(quadrature, areal.dtype, areal.device)
    taken = torch.tensor(quadrature.filter, dtype=areal.dtype, device=areal.device)
    through = [weight - own * behind for weight, own in zip(log_weights[:, 0], taken)]
    slope = -_mean(torch.stack(through), taken)
    logs = [log - torch.einsum("k,k...->...", curves, areal) for log, curves in zip(through, attenuation)]
    return slope + _mean(torch.stack(logs), taken)


def _mean(logs: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """Mean of a value at each node, weighed by (nodes, ...) logarithms."""
    return torch.einsum("n,n...->...", values, torch.softmax(logs, dim=0))
