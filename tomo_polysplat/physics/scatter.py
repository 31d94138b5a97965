"""Scattered light on top of what passes: ``I / I0 = sum_E eta(E) exp(-...) + S``.

The open beam I0 is taken without the object, so scatter from the object adds to every ray, air included. It varies
slowly over the detector: here it is a constant plus a share of the light that passes in the wide neighbourhood of a
ray. That is cruder than a convolution of what matter scatters (as Ohnesorge, Flohr, Klingenbeck-Regn 1999,
doi:10.1007/s003300050710), but needs to know nothing of the scanner; a share below 0 puts most of it behind the most
matter.

A model of the rays with a constant scattered signal is the one node of a quadrature more which nothing attenuates.
For scatter that varies, what it lacks of a level is added to the rays, whose scatter then is that level everywhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from tomo_polysplat.checks import require_number
from tomo_polysplat.physics.quadrature import Quadrature

__all__ = ["LARGEST_SCATTER", "Scatter", "add_scatter", "light_around", "made_level", "without_scatter"]

# There is no more than this, as a fraction of the open beam.
LARGEST_SCATTER = 0.2
# Standard deviation of the neighbourhood, as a share of the detector along either axis, and the pixels of the coarse
# detector on which it is taken.
_WIDTH, _COARSE = 0.2, 32
# The light of no ray is lowered by more than this share of it, which would raise its noise.
_LOWERED = 0.1
# Rays looked at together.
_CHUNK = 1 << 22


@dataclass(frozen=True)
class Scatter:
    """Scattered light, as a fraction of the open beam.

    Attributes
    ----------
    constant : float
    of_light : float
        Share of `light_around`.
    """

    constant: float = 0.0
    of_light: float = 0.0

    @property
    def varies(self) -> bool:
        """Whether it differs from ray to ray."""
        return self.of_light != 0.0

    def at(self, light: torch.Tensor) -> torch.Tensor:
        """The scatter of rays with so much light around them."""
        return (self.constant + self.of_light * light).clamp(0.0, LARGEST_SCATTER)


def light_around(values: torch.Tensor) -> torch.Tensor:
    """Light that passes in the wide neighbourhood of each ray, as a fraction of the open beam.

    Parameters
    ----------
    values : (views, rows, columns) tensor
        ``-log(I / I0)``; what is not finite does not count.
    """
    known = torch.isfinite(values)
    light = torch.where(known, torch.exp(-values).clamp(max=1.0), torch.zeros_like(values))
    rows, columns = (min(n, _COARSE) for n in values.shape[1:])
    across, along = _neighbourhood(rows, values), _neighbourhood(columns, values)
    total, count = (
        across @ torch.nn.functional.adaptive_avg_pool2d(part, (rows, columns)) @ along
        for part in (light, known.to(values.dtype))
    )
    mean = torch.where(count > 0, total / count.clamp(min=1e-12), torch.zeros_like(total))
    whole = torch.nn.functional.interpolate(mean[:, None], values.shape[1:], mode="bilinear")
    return whole[:, 0]


def _neighbourhood(pixels: int, like: torch.Tensor) -> torch.Tensor:
    """(pixels, pixels) weights of a Gaussian neighbourhood on a coarse detector."""
    place = torch.arange(pixels, dtype=like.dtype, device=like.device) / pixels
    return torch.exp(-0.5 * ((place[:, None] - place[None]) / _WIDTH) ** 2)


def made_level(values: torch.Tensor, scatter: Scatter, beam: float = 1.0) -> tuple[torch.Tensor, float]:
    """Rays as they would be if the scatter were a level everywhere, and that level.

    Parameters
    ----------
    values : (views, rows, columns) tensor
        ``-log(I / I0)``; NaN is kept.
    scatter : Scatter
        As a fraction of the beam.
    beam : float
        Brightness of the beam, in those of the open field I0.
    """
    shift = math.log(beam)
    if not scatter.varies:
        return values + shift if shift else values, scatter.constant
    chunks = values.split(max(1, _CHUNK // values[0].numel()))
    level = max(0.0, *(_least_level(chunk + shift, scatter) for chunk in chunks))
    made = torch.empty_like(values)
    for chunk, place in zip(chunks, made.split(len(chunks[0]))):
        shifted = chunk + shift
        light = torch.exp(-shifted) + (level - scatter.at(light_around(shifted)))
        # Rounding leaves some rays without any.
        place.copy_(-torch.log(light.clamp(min=torch.finfo(light.dtype).tiny)))
    return made, level


def _least_level(values: torch.Tensor, scatter: Scatter) -> float:
    """The level below which some of the rays would lose too much light."""
    needed = scatter.at(light_around(values)) - _LOWERED * torch.exp(-values)
    return float(needed.nan_to_num(nan=0.0).max())


def add_scatter(quadrature: Quadrature, scatter: float) -> Quadrature:
    """Nodes of the same spectrum under a constant scatter, a fraction of the open beam; 0 adds none."""
    if require_number("scatter", scatter, at_least=0.0) == 0:
        return quadrature
    log_weights = np.append(quadrature.log_weights, np.log(scatter))
    attenuation = np.pad(quadrature.attenuation, ((0, 0), (0, 1)))
    # Scatter comes from the object: no filter in front of it takes any away.
    behind = None if quadrature.filter is None else np.append(quadrature.filter, 0.0)
    return replace(quadrature, log_weights=log_weights, attenuation=attenuation, filter=behind)


def without_scatter(values: torch.Tensor, scatter: float, largest: float) -> torch.Tensor:
    """Projection values of what passes alone.

    Parameters
    ----------
    values : tensor
        ``-log(I / I0)``, of any shape; NaN is kept.
    scatter : float
        Constant, as a fraction of the open beam.
    largest : float
        Value of the rays that noise leaves with less signal than scatter.
    """
    # In place: of all rays of a large scan one copy is enough.
    return (-values).exp_().sub_(scatter).clamp_(min=float(np.exp(-largest))).log_().neg_()
