"""Sums over views of what a fit leaves, of which each rank takes a part of the views.

Between passes all Gaussians are on rank 0. It sends them to the others, 56 bytes each, which hold the measured rays
already: beside the images of all views that is little.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import torch

from tomo_polysplat.fit.lent_rays import about_rays, borrowed, lent
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.rank_work import gathered, helpers
from tomo_polysplat.ranks import Ranks, part_of
from tomo_polysplat.settings import Settings

__all__ = ["by_views", "portions_of", "views_at_once"]

# Gets the part of the views, how many are looked at together, and all that a sum over them is made of.
_Work = Callable[..., list[torch.Tensor]]


def views_at_once(rays: Rays, most: int, most_rays: int, images: int = 1) -> int:
    """How many views are looked at together: so many at most, and no more rays, of which there are some images."""
    return max(1, min(most, most_rays // (rays.views.rows * rays.views.columns * images)))


def portions_of(part: slice, at_once: int) -> Iterator[tuple[slice, slice]]:
    """So many views of a part of them after the other: which they are, and where in the part."""
    for first in range(part.start, part.stop, at_once):
        last = min(first + at_once, part.stop)
        yield slice(first, last), slice(first - part.start, last - part.start)


# What is done, with what of a fit, and how the views go together: nothing else holds these.
@torch.no_grad()
def by_views(
    work: _Work,
    views: int,
    at_once: int,
    gaussians: Gaussians,
    scene: FitScene,
    rays: Rays,
    settings: Settings,
    *more: Any,
) -> list[list[torch.Tensor]]:
    """What each rank makes of its part of the views, in the order of these.

    Parameters
    ----------
    work : callable
        A function of a module. Gets a slice of ``range(views)``, ``at_once`` and all that comes after it; gives tensors
        as `rank_work.gathered` takes them.
    views, at_once : int
        Views, and how many of them are looked at together. The parts are cut between such portions, so that these are
        the same for any number of ranks.
    gaussians, scene, rays, settings
        Of the fit.
    *more
        What ``work`` needs besides.
    """
    ranks, portions = helpers(), -(-views // at_once)
    if portions < ranks.count or ranks.count == 1:
        return [work(slice(0, views), at_once, gaussians, scene, rays, settings, *more)]
    shares = [part_of(portions, rank, ranks.count) for rank in range(ranks.count)]
    parts = [slice(share.start * at_once, min(share.stop * at_once, views)) for share in shares]
    with ranks.together():
        number = lent(rays.projections, ranks)
        # No rank but the first one asks what solid there is.
        told = replace(scene, solid_number=None)
        about = number, about_rays(rays), settings
        ranks.tell("work", _follow, work, parts, at_once, gaussians, told, *about, *more)
        return gathered(ranks, work(parts[0], at_once, gaussians, scene, rays, settings, *more))


# As many as `by_views` tells.
@torch.no_grad()
def _follow(
    ranks: Ranks,
    work: _Work,
    parts: list[slice],
    at_once: int,
    gaussians: Gaussians,
    scene: FitScene,
    number: int,
    about: tuple[Any, ...],
    settings: Settings,
    *more: Any,
) -> None:
    """Another rank's part."""
    rays = borrowed(ranks.lent[number], about, ranks)
    gathered(ranks, work(parts[ranks.rank], at_once, gaussians, scene, rays, settings, *more))
