"""Sums over views of what a fit leaves, of which each rank takes a part of the views.

Between passes all Gaussians are on rank 0. It sends them to the others, 56 bytes each, which hold the measured rays
already: beside the images of all views that is little.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch

from tomo_polysplat.fit.lent_rays import about_rays, borrowed, lent
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.rank_work import gathered, helpers
from tomo_polysplat.ranks import Ranks, part_of
from tomo_polysplat.settings import Settings

__all__ = ["Walk", "by_views", "views_at_once"]


class Batch(NamedTuple):
    """Some views with what was measured and what the model predicts, (views, rows, columns) each.

    Attributes
    ----------
    now, here : slice
        Which views these are: among all that are looked at, and in this rank's part of them.
    views : DetectorViews
    measured, fitted, aside : tensor
        See `Rays.batch`.
    predicted : tensor
    """

    now: slice
    here: slice
    views: DetectorViews
    measured: torch.Tensor
    fitted: torch.Tensor
    aside: torch.Tensor
    predicted: torch.Tensor


@dataclass(frozen=True, eq=False)
class Walk:
    """A walk over the views of a fit, some of them at a time.

    Attributes
    ----------
    gaussians, scene, rays, settings
        Of the fit.
    numbers : (views,) int array
        Views that are looked at, by their numbers in the scan.
    at_once : int
        Views that are looked at together.
    part : slice
        Of ``numbers``, the part of this rank; all by default.
    """

    gaussians: Gaussians
    scene: FitScene
    rays: Rays
    settings: Settings
    numbers: np.ndarray
    at_once: int
    part: slice = field(default_factory=lambda: slice(None))

    def __len__(self) -> int:
        return len(self.numbers[self.part])

    def __iter__(self) -> Iterator[Batch]:
        start, stop, _ = self.part.indices(len(self.numbers))
        for first in range(start, stop, self.at_once):
            last = min(first + self.at_once, stop)
            views, measured, fitted, aside = self.rays.batch(self.numbers[first:last])
            predicted, _ = self.scene.projections(self.gaussians, views)
            here = slice(first - start, last - start)
            yield Batch(slice(first, last), here, views, measured, fitted, aside, predicted)


# A function of a module that makes tensors, as `rank_work.gathered` takes them, of a walk and what it needs besides.
_Work = Callable[..., list[torch.Tensor]]


def views_at_once(rays: Rays, most: int, most_rays: int, images: int = 1) -> int:
    """How many views are looked at together: so many at most, and no more rays, of which there are some images."""
    return max(1, min(most, most_rays // (rays.views.rows * rays.views.columns * images)))


@torch.no_grad()
def by_views(work: _Work, walk: Walk, *more: Any) -> list[list[torch.Tensor]]:
    """What each rank makes of its part of the views, in the order of these.

    Parameters
    ----------
    work : callable
        Gets a walk over a part of the views, and all that comes after it. The parts are cut between views that are
        looked at together, so that these are the same for any number of ranks.
    walk : Walk
        Over all views.
    *more
        What ``work`` needs besides.
    """
    views, ranks = len(walk), helpers()
    portions = -(-views // walk.at_once)
    if portions < ranks.count or ranks.count == 1:
        return [work(walk, *more)]
    shares = [part_of(portions, rank, ranks.count) for rank in range(ranks.count)]
    parts = [slice(share.start * walk.at_once, min(share.stop * walk.at_once, views)) for share in shares]
    with ranks.together():
        number = lent(walk.rays.projections, ranks)
        told = {name: getattr(walk, name) for name in ("gaussians", "settings", "numbers", "at_once")}
        # No rank but the first one asks what solid there is.
        told["scene"] = replace(walk.scene, solid_number=None)
        ranks.tell("work", _follow, work, parts, told, number, about_rays(walk.rays), *more)
        return gathered(ranks, work(replace(walk, part=parts[0]), *more))


@torch.no_grad()
def _follow(
    ranks: Ranks,
    work: _Work,
    parts: list[slice],
    told: dict[str, Any],
    number: int,
    about: tuple[Any, ...],
    *more: Any,
) -> None:
    """Another rank's part."""
    rays = borrowed(ranks.lent[number], about, ranks)
    gathered(ranks, work(Walk(rays=rays, part=parts[ranks.rank], **told), *more))
