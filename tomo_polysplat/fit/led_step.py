"""A step that rank 0 makes together with all others, as the fit sees it."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch

from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.fit.step import Moments, Step
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.ranks import Ranks

__all__ = ["LedStep", "fingerprint", "state_of"]

# Numbers below 2^53 stay exact in double precision.
_PRINTS = 1 << 52


class LedStep:
    """Rank 0's step; see `fit.step.Step`.

    The others hold a step of the same Gaussians and rays under a number. They do what this one does when they are told
    so. Between passes the fit changes Gaussians, moments and rays of rank 0 alone: before the next step they are sent.

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
        gaussians, spacing, rays, scene, settings = setup
        self._ranks, self._gaussians, self._projections = ranks, gaussians, rays.projections
        self._number = ranks.number()
        weakref.finalize(self, ranks.let_go, self._number).atexit = False
        self._own: Step
        full = ""
        with ranks.together():
            views = rays.views
            parts = {
                "gaussians": gaussians,
                "spacing": spacing,
                "rays": (rays.photons, rays.model_error, rays.held_out, rays.dimmed),
                "views": (views.cone, views.origin, views.matrix, views.rows, views.columns, views.planar),
                # No rank but the first one asks it.
                "scene": replace(scene, solid_number=None),
                "settings": settings,
                "batch": batch,
                "beside": 0 if beside is None else beside._number,
            }
            ranks.tell("make", self._number, _lent(self._projections, ranks), parts)
            shared: Step | None = None if beside is None else beside._own
            try:
                self._own = make(setup, batch, ranks, shared)
            except torch.cuda.OutOfMemoryError as problem:
                full = str(problem) or "no room"
        if full:
            raise torch.cuda.OutOfMemoryError(full)
        self.pull, self.moments = self._own.pull, self._own.moments
        self._changed = True
        self._rates: dict[str, float] | None = None

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
        # Each rank has its own, of its views and its slab; they change roundings only.
        self._own.largest = values

    def set_rates(self, rates: Mapping[str, float]) -> None:
        """See `Step`."""
        self._own.set_rates(rates)
        self._rates, self._changed = dict(rates), True

    def __call__(self, views: np.ndarray, share: float) -> None:
        """One step; see `Step`."""
        with self._ranks.together():
            if changed := self._changed:
                _lent(self._projections, self._ranks)
                state = state_of(self._gaussians, self.moments)
                self._ranks.tell("state", self._number, state, self.done, self._rates)
                self._changed = False
            self._ranks.tell("step", self._number, views, share, changed)
            self._own(views, share)
            # Once a pass: a GPU is waited for.
            if changed and not self._ranks.same(fingerprint(self._gaussians)):
                raise RuntimeError(
                    "the ranks' Gaussians differ after the same step: devices of several kinds?"
                )

    def read(self) -> tuple[float, float, int]:
        """Means since the last call; see `Step`."""
        with self._ranks.together():
            self._ranks.tell("read", self._number)
            told = self._own.read()
        self._changed = True
        return told


def state_of(gaussians: Gaussians, moments: Moments) -> list[torch.Tensor]:
    """All that a step changes."""
    own = [getattr(gaussians, part.name) for part in fields(gaussians)]
    return [*own, *(moment for name in sorted(moments) for moment in moments[name])]


def fingerprint(gaussians: Gaussians) -> int:
    """A number that two clouds share only if they are the same to the last bit."""
    total = 0
    for tensor in gaussians.parameters().values():
        bits = tensor.detach().reshape(-1).view(torch.int32).long()
        # So that bits that have changed places are told as well.
        weights = torch.arange(1, len(bits) + 1, device=bits.device) % 8191 + 1
        total = (31 * total + int((bits * weights).sum())) % _PRINTS
    return total


def _lent(tensor: torch.Tensor, ranks: Ranks) -> int:
    """The number under which the others hold the measured rays, which are sent when they are new or have changed."""
    lent: dict[int, Any] = ranks.lent
    number, version = lent.get(id(tensor), (0, -1))
    if not number:
        number = ranks.number()

        def forget(key: int = id(tensor), number: int = number) -> None:
            lent.pop(key, None)
            ranks.let_go(number)

        weakref.finalize(tensor, forget).atexit = False
    if version != tensor._version:
        lent[id(tensor)] = (number, tensor._version)
        ranks.tell("rays", number, tensor)
    return number
