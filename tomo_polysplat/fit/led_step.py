"""A step that rank 0 makes together with all others, as the fit sees it."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from tomo_polysplat.fit.lent_rays import about_rays, lent
from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.fit.shares import Part, fit_in, parted, planes_of_all
from tomo_polysplat.fit.step import Moments, Step
from tomo_polysplat.model.gaussians import OF_ALL, Gaussians
from tomo_polysplat.ranks import Ranks

__all__ = ["LedStep", "of_all", "of_all_moments", "of_each", "of_each_moment"]


class LedStep:
    """Rank 0's step; see `fit.step.Step`.

    Every rank holds a step of its own part of the Gaussians, under a number, and makes it when it is told so. Between
    passes the Gaussians of all ranks are together here, where the fit may change them: before the next step each gets
    its own. The optimiser's memory comes and goes only if the fit asks for it.

    Parameters
    ----------
    make : callable
        Makes this rank's own step.
    setup, batch
        See `fit.choose_step.make_step`.
    ranks : Ranks
    beside : LedStep, optional
        Another one of the same run, never made at the same time.

    Raises
    ------
    torch.cuda.OutOfMemoryError
        Where the device of a rank has no room for its part; more can be made together all the same.
    """

    def __init__(
        self,
        make: Callable[..., Step],
        setup: FitSetup,
        batch: int,
        ranks: Ranks,
        beside: LedStep | None = None,
    ) -> None:
        self._make, self._setup, self._batch, self._ranks = make, setup, batch, ranks
        self._beside: Any = (lambda: None) if beside is None else weakref.ref(beside)
        self.pull = torch.zeros_like(setup.gaussians.attenuation)
        self._rates: dict[str, float] | None = None
        # The optimiser's memory of all Gaussians, from when it is asked for until the next step.
        self._whole: Moments | None = None
        self._changed = True
        with ranks.together():
            self._parts = parted(setup.gaussians, ranks.count)
            full = self._begin()
        if full:
            raise torch.cuda.OutOfMemoryError(full)

    def _begin(self) -> str:
        """Have each rank make a step of its part; why one has no room for it, if so."""
        setup, ranks = self._setup, self._ranks
        gaussians, _, rays, scene, _ = setup
        self._planes = planes_of_all(gaussians, self._parts, scene.box)
        self._number = ranks.number()
        self._let_go = weakref.finalize(self, ranks.let_go, self._number)
        self._let_go.atexit = False
        beside = self._beside()
        counts = [len(part) for part in self._parts]
        about = {
            # None of them, for their kinds.
            "gaussians": gaussians.select(self._parts[0][:0]),
            "counts": counts,
            "planes": self._planes,
            "spacing": setup.spacing,
            "rays": about_rays(rays),
            # No rank but the first one asks it.
            "scene": replace(scene, solid_number=None),
            "settings": setup.settings,
            "batch": self._batch,
            "beside": 0 if beside is None else beside._number,
        }
        ranks.tell("make", self._number, lent(rays.projections, ranks), about)
        self._hand_out(list(gaussians.each().values()))
        with torch.no_grad():
            common = {name: getattr(gaussians, name).clone() for name in OF_ALL}
            own = Gaussians(**gaussians.select(self._parts[0]).each(), **common)
        part = Part(ranks, self._planes[0], gaussians.position.device)
        shared: Step | None = None if beside is None else beside._own
        try:
            self._own: Step = self._make(setup._replace(gaussians=own), self._batch, ranks, shared, part)
        except torch.cuda.OutOfMemoryError as problem:
            return str(problem) or "no room"
        self._own_gaussians = own
        return ""

    @property
    def moments(self) -> Moments:
        """See `Step`; changes of it reach the other ranks with the next step."""
        if self._whole is None:
            with self._ranks.together():
                self._collect_moments()
        assert self._whole is not None
        return self._whole

    @property
    def done(self) -> int:
        """See `Step`."""
        return self._own.done

    @done.setter
    def done(self, steps: int) -> None:
        self._own.done, self._changed = steps, True

    @property
    def largest(self) -> list[float]:
        """See `Step`."""
        return self._own.largest

    @largest.setter
    def largest(self, values: list[float]) -> None:
        # Each rank has its own, of its slab; they change roundings only.
        self._own.largest = values

    def set_rates(self, rates: Mapping[str, float]) -> None:
        """See `Step`."""
        self._own.set_rates(rates)
        self._rates, self._changed = dict(rates), True

    def __call__(self, views: np.ndarray, share: float) -> None:
        """One step; see `Step`."""
        with self._ranks.together():
            if self._changed:
                self._send()
                self._changed = False
            self._ranks.tell("step", self._number, views, share)
            self._own(views, share)

    def read(self) -> tuple[float, float, int]:
        """Means since the last call; see `Step`. The Gaussians of all ranks are here after it."""
        with self._ranks.together():
            self._ranks.tell("read", self._number)
            told = self._own.read()
            whole, own = self._setup.gaussians, self._own_gaussians
            self._collect([*of_each(whole), self.pull], [*of_each(own), self._own.pull])
            _copy(of_all(own), of_all(whole))
        self._changed = True
        return told

    @torch.no_grad()
    def _send(self) -> None:
        """What the fit has changed between two passes."""
        gaussians, box = self._setup.gaussians, self._setup.scene.box
        lent(self._setup.rays.projections, self._ranks)
        if self._whole is not None:
            # With their memory at hand each can go to whoever is to hold it now.
            self._parts = parted(gaussians, self._ranks.count)
        if not fit_in(gaussians, self._parts, box, self._planes):
            self._anew()
        own, moments = self._own_gaussians, self._whole
        common = [of_all(gaussians), [] if moments is None else of_all_moments(moments)]
        self._ranks.tell("state", self._number, self.done, self._rates, common, moments is not None)
        _copy(common[0], of_all(own))
        self._hand_out([*of_each(gaussians), self.pull], [*of_each(own), self._own.pull])
        if moments is not None:
            _copy(common[1], of_all_moments(self._own.moments))
            self._hand_out(of_each_moment(moments), of_each_moment(self._own.moments))
            self._whole = None

    def _anew(self) -> None:
        """Steps of other parts, where Gaussians have left the planes of theirs."""
        if self._whole is None:
            self._collect_moments()
            self._parts = parted(self._setup.gaussians, self._ranks.count)
        done, largest = self.done, self.largest
        self._let_go()
        # What the old step holds on its way is as much again.
        del self._own, self._own_gaussians
        if full := self._begin():
            raise torch.cuda.OutOfMemoryError(full)
        self._own.done, self._own.largest = done, largest
        if self._rates is not None:
            self._own.set_rates(self._rates)

    @torch.no_grad()
    def _collect_moments(self) -> None:
        self._ranks.tell("moments", self._number)
        own, count = self._own.moments, len(self.pull)
        self._whole = {
            name: tuple(m.clone() if name in OF_ALL else m.new_zeros((count, *m.shape[1:])) for m in pair)  # type: ignore[misc]
            for name, pair in own.items()
        }
        self._collect(of_each_moment(self._whole), of_each_moment(own))

    @torch.no_grad()
    def _hand_out(self, whole: list[torch.Tensor], own: list[torch.Tensor] | None = None) -> None:
        """To each rank its part of what there is of each Gaussian; this one's into ``own``."""
        for rank in range(1, self._ranks.count):
            self._ranks.send((tensor.index_select(0, self._parts[rank]) for tensor in whole), rank)
        for tensor, mine in zip(whole, own or ()):
            torch.index_select(tensor, 0, self._parts[0], out=mine.detach())

    @torch.no_grad()
    def _collect(self, whole: list[torch.Tensor], own: list[torch.Tensor]) -> None:
        """From each rank the same."""
        for rank, part in enumerate(self._parts):
            for tensor, mine in zip(whole, own):
                got = mine.detach()
                if rank:
                    got = tensor.new_empty((len(part), *tensor.shape[1:]))
                    self._ranks.receive([got], rank)
                tensor.index_copy_(0, part, got)


def of_each(gaussians: Gaussians) -> list[torch.Tensor]:
    """What each Gaussian has of its own."""
    return list(gaussians.each().values())


def of_all(gaussians: Gaussians) -> list[torch.Tensor]:
    """What all Gaussians share."""
    return [getattr(gaussians, name) for name in OF_ALL]


def of_each_moment(moments: Moments) -> list[torch.Tensor]:
    """What the optimiser remembers of each Gaussian."""
    return [moment for name in sorted(moments) if name not in OF_ALL for moment in moments[name]]


def of_all_moments(moments: Moments) -> list[torch.Tensor]:
    """What it remembers of what all share."""
    return [moment for name in OF_ALL for moment in moments[name]]


@torch.no_grad()
def _copy(told: list[torch.Tensor], own: list[torch.Tensor]) -> None:
    for tensor, mine in zip(told, own):
        mine.copy_(tensor)
