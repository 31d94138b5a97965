"""Measured rays that rank 0 lends to the others: sent once, and again where they have changed."""

from __future__ import annotations

import weakref
from typing import Any

import torch

from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.ranks import Ranks

__all__ = ["about_rays", "borrowed", "lent"]


def lent(tensor: torch.Tensor, ranks: Ranks) -> int:
    """The number under which the others hold the measured rays, which are sent when they are new or have changed."""
    known: dict[int, Any] = ranks.lent
    number, version = known.get(id(tensor), (0, -1))
    if not number:
        number = ranks.number()

        def forget(key: int = id(tensor), number: int = number) -> None:
            known.pop(key, None)
            ranks.let_go(number)

        weakref.finalize(tensor, forget).atexit = False
    if version != tensor._version:
        known[id(tensor)] = (number, tensor._version)
        ranks.tell("rays", number, tensor)
    return number


def about_rays(rays: Rays) -> tuple[Any, ...]:
    """All that `borrowed` needs beside the measured values."""
    views = rays.views
    detector = (views.cone, views.origin, views.matrix, views.rows, views.columns, views.planar)
    return (rays.photons, rays.model_error, rays.held_out, rays.dimmed), detector


def borrowed(projections: torch.Tensor, about: tuple[Any, ...], ranks: Ranks) -> Rays:
    """The rays of rank 0, as another rank sees them."""
    streamed = ranks.device if projections.device.type != ranks.device.type else None
    (photons, model_error, held_out, dimmed), detector = about
    return Rays(projections, DetectorViews(*detector), photons, model_error, held_out, streamed, dimmed)
