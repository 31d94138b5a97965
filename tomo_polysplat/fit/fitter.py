"""One run of the optimiser: its steps, the order of the views, and the moves of Gaussians between passes."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch

from tomo_polysplat.fit.choose_step import make_step
from tomo_polysplat.fit.finer import may_be_finer
from tomo_polysplat.fit.learning_rates import hurried
from tomo_polysplat.fit.light_matter import tell_light
from tomo_polysplat.fit.metal_numbers import number_metals
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.fit.snapshot import Snapshot
from tomo_polysplat.fit.soft_matter import flatten
from tomo_polysplat.fit.step import Step, log_scale_bounds, step_rates
from tomo_polysplat.fit.stopping import Clock
from tomo_polysplat.kernels.compile_time import working_time
from tomo_polysplat.kernels.spatial_order import spatial_order
from tomo_polysplat.model.density_control import grow, relocate, splittable
from tomo_polysplat.model.gaussians import OF_ALL, Gaussians

__all__ = ["Batches", "Fitter", "next_views", "steps_of_a_run"]

# A pass over fewer views than this makes the steps of one over as many.
_FEWEST_VIEWS = 10
# Where a cloud grows, this share of it is split between passes, from so early in the run on: before, seeds are pulled
# to where they belong. Broccoli of 44^3 and, in twice the room, of 36^3 voxels, four times as many Gaussians: +1.61 and
# +0.81 dB, a pass earlier +1.59 and +0.72, a third at a time to three times as many +1.27 and +0.56.
_SPLIT, _SPLIT_FROM = 0.5, 0.14


class Batches(NamedTuple):
    """Views of a step, steps of the run, by which learning rates go, and who draws the order of the views."""

    views: int
    steps: int
    rng: np.random.Generator


class Fitter:
    """One run: its steps, the order of the views, and the moves of Gaussians between passes.

    Parameters
    ----------
    setup : FitSetup
        Its settings as they are for any number of steps.
    batches : Batches
    beside : Fitter, optional
        Another run on the same rays that never steps at the same time: both use the same memory on the way.
    """

    def __init__(self, setup: FitSetup, batches: Batches, beside: Fitter | None = None) -> None:
        batch, steps, self.rng = batches
        gaussians, self.spacing, rays, self.scene, settings = setup
        self.gaussians, self.rays, self.settings = gaussians, rays, settings
        hurry, shared = hurried(settings, steps), None if beside is None else beside.step
        self.step: Step = make_step(setup._replace(settings=hurry), batch=batch, beside=shared)
        self.batch, self.order = batch, np.empty(0, int)
        self.steps = steps
        self.steps_of_a_pass = max(1, round(_views_of_a_pass(rays) / batch))
        self.relocated = 0
        self.relocation_due = False
        light = int(splittable(gaussians, settings.bone_level).sum())
        self.most = len(gaussians) + math.floor(max((settings.growth or 1.0) - 1.0, 0.0) * light)

    def passes(self, clock: Clock) -> Iterator[tuple[float, float, int]]:
        """Step until the clock runs out; what each pass over the views gave, the last perhaps a part of one.

        That is the mean misfit of the fitted rays and of those held out, and the pairs skipped.
        """
        made, begun = 0, 0.0
        while (share := clock.share()) < 1:
            if self.relocation_due and share >= _SPLIT_FROM and len(self.gaussians) < self.most:
                self._grow()
            elif self.relocation_due:
                self._relocate()
            views = self._next_views(self.batch)
            self.step(views, share)
            clock.done += 1
            clock.tick()
            clock.look_ahead(self.settle)
            made += 1
            if made == 1:
                # The first step of a pass may wait for what lies between passes, and the first of all compiles.
                begun = working_time()
            if made == self.steps_of_a_pass:
                self.relocation_due = share < self.settings.relocate_until
                if made > 1:
                    self._learn_as_in(clock.expected_steps((working_time() - begun) / (made - 1)))
                yield self._end_pass(share)
                made = 0
        if made:
            yield self._end_pass(1.0)

    def settle(self) -> None:
        """Wait until the steps that were asked for are made."""
        device = self.gaussians.position.device
        if device.type == "cuda":
            # Its own work alone: while another thread records a graph, nobody may wait for the whole device.
            torch.cuda.current_stream(device).synchronize()

    def ahead(self, clock: Clock, passes: int) -> list[tuple[float, float, int]]:
        """What so many more passes gave, as `passes` tells it."""
        return list(itertools.islice(self.passes(clock), passes))

    def branch(self, **changes: Any) -> Fitter:
        """The same run from here on, with changes to its scene by name, on Gaussians of its own."""
        scene, rng = replace(self.scene, **changes), copy.deepcopy(self.rng)
        setup = FitSetup(self.gaussians.copy(), self.spacing, self.rays, scene, self.settings)
        other = Fitter(setup, Batches(self.batch, self.steps, rng), beside=self)
        other.restore(self.snapshot(None, {}))
        return other

    def _learn_as_in(self, steps: int) -> None:
        """Take the learning rates of a run of so many steps."""
        if steps != self.steps:
            self.steps = steps
            self.step.set_rates(step_rates(hurried(self.settings, steps), self.spacing))

    @torch.no_grad()
    def _end_pass(self, share: float) -> tuple[float, float, int]:
        # Before anything is changed: what several ranks hold is put together here.
        told = self.step.read()
        # Once a pass does: in its few steps a Gaussian does not get far beyond the volume.
        self.scene.keep_within(self.gaussians)
        # What is not finite any more is nowhere to look at, and `Watch` ends the run.
        if self.gaussians.finite():
            flatten(self.gaussians, self.scene, self.settings, share)
            number_metals(self.gaussians, self.scene, self.settings, share)
            tell_light(self.gaussians, self.scene, share)
        else:
            self.relocation_due = False
        return told

    def snapshot(self, best: Gaussians | None, numbers: dict[str, Any]) -> Snapshot:
        """Where the fit stands between two passes; ``numbers`` of the run are kept with it."""
        own = {
            "steps_made": self.step.done,
            "pace": self.steps,
            "largest": self.step.largest,
            "relocated": self.relocated,
            "relocation_due": self.relocation_due,
            "most": self.most,
            "random": self.rng.bit_generator.state,
        }
        first, second = ({k: pair[j] for k, pair in self.step.moments.items()} for j in (0, 1))
        return Snapshot(self.gaussians, best, first, second, self.step.pull, self.order, own | numbers)

    @torch.no_grad()
    def restore(self, kept: Snapshot) -> None:
        """Go on from a snapshot, with whose Gaussians this was made."""
        for name, (first, second) in self.step.moments.items():
            first.copy_(kept.first[name])
            second.copy_(kept.second[name])
        self.step.pull.copy_(kept.pull)
        self.order = kept.order
        self.step.done = int(kept.numbers["steps_made"])
        self._learn_as_in(int(kept.numbers["pace"]))
        self.step.largest = kept.numbers["largest"]
        self.relocated = int(kept.numbers["relocated"])
        self.relocation_due = bool(kept.numbers["relocation_due"])
        self.most = int(kept.numbers["most"])
        self.rng.bit_generator.state = kept.numbers["random"]

    @torch.no_grad()
    def _relocate(self) -> None:
        """Put Gaussians that hold nothing where they are wanted, with a fresh memory of the optimiser."""
        self.relocation_due = False
        smallest, _ = log_scale_bounds(self.scene, self.spacing, self.gaussians.planar, self.settings)
        may = may_be_finer(self.gaussians, self.scene, smallest)
        changed = relocate(self.gaussians, self.step.pull, self.settings.relocated, may)
        self.step.pull.zero_()
        if not len(changed):
            return
        self.relocated += len(changed) // 2
        own = self.gaussians.each()
        memory = [moment for name in own for moment in self.step.moments.get(name, ())]
        for moment in memory:
            moment[changed] = 0.0
        # What was moved stands where the dead were in the list: groups of it would reach across the volume, which
        # makes the kernels' images several times slower.
        order = spatial_order(self.gaussians.position)
        for tensor in (*own.values(), *memory):
            tensor.copy_(tensor[order])

    @torch.no_grad()
    def _grow(self) -> None:
        """Split Gaussians where the rays ask for more detail, with a fresh memory of the optimiser."""
        self.relocation_due = False
        before, old = len(self.gaussians), self.step
        moments_before, done, largest = old.moments, old.done, old.largest
        dense = self.settings.bone_level
        count = math.ceil(_SPLIT * int(splittable(self.gaussians, dense).sum()))
        grown, changed = grow(self.gaussians, old.pull, min(count, self.most - before), dense)
        order = spatial_order(grown.position)
        self.gaussians = grown.select(order)
        hurry = hurried(self.settings, self.steps)
        # What the old step holds on its way is as much again, and too small for the new one.
        del old, self.step
        setup = FitSetup(self.gaussians, self.spacing, self.rays, self.scene, hurry)
        self.step = make_step(setup, batch=self.batch)
        for name, moments in self.step.moments.items():
            for moment, kept in zip(moments, moments_before[name]):
                if name in OF_ALL:
                    moment.copy_(kept)
                    continue
                wider = torch.cat([kept, kept.new_zeros((len(grown) - before, *kept.shape[1:]))])
                wider[changed] = 0.0
                moment.copy_(wider[order])
        self.step.done, self.step.largest = done, largest

    def _next_views(self, batch: int) -> np.ndarray:
        chosen, self.order = next_views(self.order, batch, len(self.rays.views), self.rng)
        return chosen


def next_views(
    order: np.ndarray, batch: int, views: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """The next views of an order that uses each once before any again, and the order left."""
    while len(order) < batch:
        order = np.concatenate([order, rng.permutation(views)])
    return order[:batch], order[batch:]


def steps_of_a_run(passes: float, rays: Rays, batch: int) -> int:
    """Steps of so many views each that passes over all of them come to."""
    return max(1, math.ceil(passes * _views_of_a_pass(rays) / batch))


def _views_of_a_pass(rays: Rays) -> int:
    """Views that the steps of a pass use: a scan of few views is seen more than once in it."""
    return max(len(rays.views), _FEWEST_VIEWS)
