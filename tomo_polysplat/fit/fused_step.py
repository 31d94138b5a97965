"""The step of the optimiser as a dozen CUDA kernels of our own, without autograd.

The mathematics are those of `EagerStep`; what changes from step to step reaches the kernels through one small
tensor, so that the same launches do for every step (`graph_step.py` records them once).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Generic, TypeVar

import numpy as np
import torch

from tomo_polysplat.fit.adam import EPSILON, new_moments
from tomo_polysplat.fit.feed import feed
from tomo_polysplat.fit.loss import huber_width
from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.fit.shares import Part
from tomo_polysplat.fit.step import (
    held_out_mean,
    log_scale_bounds,
    smoothing,
    step_rates,
    turning,
)
from tomo_polysplat.free_memory import free_bytes
from tomo_polysplat.kernels.portions import portions
from tomo_polysplat.kernels.project import triton_backward as rays_backward
from tomo_polysplat.kernels.project import triton_forward as rays_forward
from tomo_polysplat.kernels.project.triton_image import spread
from tomo_polysplat.kernels.project.triton_pull_back import pull_back as rays_pull_back
from tomo_polysplat.kernels.project.triton_setup import footprints
from tomo_polysplat.kernels.step.triton_activate import activate
from tomo_polysplat.kernels.step.triton_detector import detected_misfit_gradient
from tomo_polysplat.kernels.step.triton_misfit import Measurement, Splat, misfit_gradient
from tomo_polysplat.kernels.step.triton_update import FIRST_DECAY, SECOND_DECAY, Bounds, update, update_shared
from tomo_polysplat.kernels.step.triton_variation import variation_gradient
from tomo_polysplat.kernels.voxelise import triton_backward as box_backward
from tomo_polysplat.kernels.voxelise import triton_forward as box_forward
from tomo_polysplat.kernels.voxelise.triton_setup import box_table, ellipsoids
from tomo_polysplat.model.gaussians import OF_ALL
from tomo_polysplat.physics.detector_blur import LARGEST_BLUR
from tomo_polysplat.physics.transmission import nodes_on
from tomo_polysplat.render.renderer import RAY_CUTOFF, VOXEL_CUTOFF

__all__ = ["FusedStep"]

# Numbers of the control tensor, in its order: of the update, and of each view its number and slot, and its geometry.
# Every part begins at 16 bytes whatever the batch: elsewhere the kernels would be compiled once more.
_HEAD, _CHOSEN, _VIEW = 4, 2, 21

# Bytes of a Gaussian that both halves of a step use: what is drawn and its ellipsoid, and its footprint in a view; and
# the share of what is free that may be kept so.
_PASSING, _RECORD, _KEPT = 92, 80, 0.25

# Position, deviation, rotation and weights.
_Drawn = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


_Thing = TypeVar("_Thing")


class _Made(Generic[_Thing]):
    """What is made of a portion of the Gaussians, by its number: once if below ``keeps``, else each time."""

    def __init__(self, make: Callable[[int], _Thing], keeps: int) -> None:
        self._make, self._keeps, self._kept = make, keeps, dict[int, _Thing]()

    def __call__(self, number: int) -> _Thing:
        if number >= self._keeps:
            return self._make(number)
        if number not in self._kept:
            self._kept[number] = self._make(number)
        return self._kept[number]


class FusedStep:
    """The step kernel by kernel; see `fit.step.Step`.

    Parameters
    ----------
    setup : FitSetup
    batch : int
        Views of a step.
    part : Part, optional
        With it the Gaussians are those of one rank of several, whose images and volumes are added up.
    """

    # What differs between scenes is set up once, for kernels that are given addresses.
    def __init__(self, setup: FitSetup, batch: int, part: Part | None = None) -> None:
        gaussians, spacing, rays, scene, settings = setup
        self.gaussians, self.rays, self.scene, self.settings = gaussians, rays, scene, settings
        self.done, self._unread = 0, 0
        self._batch, self.part = batch, part
        parameters, device = gaussians.parameters(), gaussians.position.device
        self.pull, self.moments = torch.zeros_like(gaussians.attenuation), new_moments(parameters)
        self.feed = feed(rays.projections, rays.target, batch)
        rates = step_rates(settings, spacing)
        self._rates = torch.tensor([rates[k] for k in parameters], dtype=torch.float32, device=device)
        bounds = log_scale_bounds(scene, spacing, gaussians.planar, settings)
        self._bounds = Bounds(bounds, (scene.least_u, 1.0), LARGEST_BLUR, EPSILON)
        fine = scene.fine(rays.views)
        self._table = fine.host_table()
        # Only the shape of these views counts.
        self._views = fine.select(np.arange(batch))
        self._portions = portions(len(gaussians), batch)
        # Of so many portions what a step makes on its way is kept, of the others it is made twice.
        self._keeps = _kept(len(gaussians), len(self._portions), batch, device)
        self._parts = (fine.rows // rays.views.rows, fine.columns // rays.views.columns)
        self._sums = torch.zeros(3, dtype=torch.float64, device=device)
        self._skipped = torch.zeros((), dtype=torch.int64, device=device)
        # The largest values so far of an image and of a volume, for sums that do not depend on their order.
        self._largest = torch.zeros((2, 1), dtype=torch.float32, device=device)
        self._grad_shared = torch.zeros(len(gaussians.shared_material), dtype=torch.int64, device=device)
        self._grad_blur = torch.zeros(1, dtype=torch.int64, device=device)
        self._control = torch.zeros(_HEAD + batch * (_CHOSEN + _VIEW), dtype=torch.float64, device=device)
        self._no_blur = torch.zeros(1, dtype=torch.float32, device=device)
        self._curves = None
        if scene.reference_curve is not None and scene.output_curve is not None:
            self._curves = torch.cat([scene.reference_curve, scene.output_curve])
        self._measurement = self._measure()
        self._box = scene.box if part is None else part.box(scene.box)
        self._box_table = box_table(self._box, device)
        largest = self._portions[0].stop
        self._not_smoothed = tuple(
            torch.zeros(shape, device=device)
            for shape in ((largest, 3), (largest, 3), (largest, 4), (1, largest))
        )

    @property
    def largest(self) -> list[float]:
        """Largest value so far of an image and of a volume; see `Step`."""
        return self._largest[:, 0].tolist()

    @largest.setter
    def largest(self, values: list[float]) -> None:
        if values:
            self._largest.copy_(torch.tensor(values)[:, None])

    def _measure(self) -> Measurement:
        rays, scene, settings = self.rays, self.scene, self.settings
        nodes = None
        if scene.quadrature is not None:
            nodes = nodes_on(scene.quadrature, torch.float32, rays.target)
        return Measurement(
            self.feed.projections,
            rays.totals,
            rays.noise,
            rays.threshold,
            huber_width(settings),
            scene.areal_scale,
            nodes,
            *self._filters(),
        )

    def _filters(self) -> tuple[torch.Tensor | None, torch.Tensor | None]:
        """What pixels are behind, and its attenuation at the nodes, as `Measurement` has them."""
        rays, scene = self.rays, self.scene
        if rays.dimmed is None:
            return None, None
        dimmed = rays.dimmed[None].float()
        if scene.quadrature is None or scene.behind is None or scene.quadrature.filter is None:
            return torch.cat([torch.zeros_like(dimmed).expand(2, -1, -1), dimmed]), None
        by_node = torch.tensor(scene.quadrature.filter, dtype=torch.float32, device=rays.target)
        return torch.cat([scene.behind, dimmed]), by_node

    def __call__(self, views: np.ndarray, share: float) -> None:
        """One step; see `Step`."""
        smooth = smoothing(self.settings, self.scene, self.done)
        values = self._next(views, share)
        self._control.copy_(torch.from_numpy(values))
        self._enqueue(smooth)
        self.feed.used()

    def set_rates(self, rates: Mapping[str, float]) -> None:
        """Go on with these; see `Step`."""
        values = [rates[name] for name in self.gaussians.parameters()]
        self._rates.copy_(torch.tensor(values, dtype=torch.float32))

    def read(self) -> tuple[float, float, int]:
        """Means since the last call; see `Step`."""
        sums = (*self._sums.tolist(), int(self._skipped))
        fitted, held_out, weight, skipped = sums
        if self.part is not None:
            (skipped,) = self.part.ranks.total(skipped)
        steps = self._unread
        self._sums.zero_()
        self._skipped.zero_()
        self._unread = 0
        return fitted / steps, held_out_mean(held_out, weight, self.rays.typical_weight), round(skipped)

    def _next(self, views: np.ndarray, share: float) -> np.ndarray:
        """What the control tensor must hold for the next step."""
        turns = turning(self.done)
        self.done += 1
        self._unread += 1
        rate = self.settings.final_rate**share / (1 - FIRST_DECAY**self.done)
        root = math.sqrt(1 - SECOND_DECAY**self.done)
        head = [rate, root, float(share >= self.settings.material_from), turns]
        slots = self.feed.place(views)
        return np.concatenate([head, views, slots, self._table[views].ravel()])

    def _enqueue(self, smooth: float) -> None:
        """All kernels of a step that smooths with this weight; what else they read of it is in the control tensor."""
        for summands in self._stages(smooth):
            self._add_up(summands)

    def _add_up(self, summands: tuple[torch.Tensor, ...]) -> None:
        assert self.part is not None
        self.part.ranks.sum_(*summands)

    def _parts_of_control(self) -> tuple[torch.Tensor, ...]:
        return self._control.split([_HEAD, self._batch * _CHOSEN, self._batch * _VIEW])

    # The order of a step and what each part leaves to the next: cut up it would be passed around.
    def _stages(self, smooth: float) -> Iterator[tuple[torch.Tensor, ...]]:
        """The same in stages; each but the last ends with what ranks add up, where there are several."""
        part, numbers, keeps = self.part, range(len(self._portions)), self._keeps
        _, chosen, table = self._parts_of_control()
        table, chosen = table.view(self._batch, _VIEW), chosen.view(_CHOSEN, self._batch)
        drawn = _Made(self._activated, keeps)
        seen = _Made(lambda number: self._footprints(drawn(number), table), keeps)
        boxed = _Made(lambda number: self._ellipsoids(drawn(number)), keeps)
        for number in numbers[:keeps]:
            # Here, as both streams use them.
            drawn(number)
        lent: tuple[torch.Tensor, ...] = ()
        if smooth:
            with self._beside():
                volume = self._voxelised(boxed)
                if part is not None:
                    lent = (part.lent(volume[0]),)
                else:
                    slope = self._slope(volume, smooth)
                    del volume
        image, skipped = self._image(seen), None if keeps == len(numbers) else self._skipped.clone()
        if part is not None:
            self._join()
            yield (image, *lent)
            if smooth:
                with self._beside():
                    part.take(lent[0], volume[0])
                    slope = self._slope(volume, smooth)
                    del volume
        pixels = self._misfit_gradient(image, table, chosen)
        del image
        for number in numbers:
            of_volume = self._none_of_volume(number)
            if smooth:
                with self._beside():
                    of_volume = self._of_volume(drawn(number), boxed(number), slope)
            of_rays = self._of_rays(drawn(number), seen(number), table, pixels)
            self._join()
            self._update(number, drawn(number), of_rays, of_volume)
            del of_rays, of_volume
        if skipped is not None:
            # Those that were made twice count once.
            self._skipped.copy_(skipped)
        if part is not None and self._curves is not None:
            yield (self._grad_shared,)
        self._update_shared()

    def _activated(self, number: int) -> tuple[_Drawn, torch.Tensor]:
        """What is drawn of a portion, with the weights that the rays see, and the weight in the volume (1, n)."""
        gaussians, some = self.gaussians, self._portions[number]
        scale, weight, output = activate(
            gaussians.log_scale[some],
            gaussians.attenuation[some],
            gaussians.own_material[some],
            gaussians.shared_material,
            gaussians.group[some],
            self._curves,
        )
        return (gaussians.position[some], scale, gaussians.rotation[some], weight), output

    def _update(self, number: int, drawn: tuple[_Drawn, torch.Tensor], of_rays, of_volume) -> None:
        some, (head, _, _) = self._portions[number], self._parts_of_control()
        common = {name: getattr(self.gaussians, name) for name in OF_ALL}
        parameters = self.gaussians.parameters()
        own = {name: tensor[some] for name, tensor in parameters.items() if name not in common}
        update(
            own | common,
            self.gaussians.group[some],
            {name: (self.moments[name][0][some], self.moments[name][1][some]) for name in own},
            (drawn[0][1], self._curves),
            of_rays,
            of_volume,
            (self._grad_shared, self.pull[some], self._rates, head),
            self._bounds,
        )

    def _update_shared(self) -> None:
        update_shared(
            self.gaussians.parameters(),
            self.moments,
            None if self._curves is None else self._grad_shared,
            self._grad_blur if self.scene.blurring else None,
            self._rates,
            self._parts_of_control()[0],
            self._bounds,
        )

    def _footprints(self, drawn: tuple[_Drawn, torch.Tensor], table: torch.Tensor) -> torch.Tensor:
        return footprints(*drawn[0], self._views, table, RAY_CUTOFF, self._skipped)

    def _image(self, seen: _Made[torch.Tensor]) -> torch.Tensor:
        """The step's views of all portions."""
        channels = 1 if self._curves is None else 3
        image = self._largest.new_zeros(
            (self._batch, self._views.rows, self._views.columns, spread(channels))
        )
        for number in range(len(self._portions)):
            rays_forward.splat(seen(number), channels, self._views, RAY_CUTOFF, self._largest[0], image)
        return image

    def _misfit_gradient(
        self, image: torch.Tensor, table: torch.Tensor, chosen: torch.Tensor
    ) -> torch.Tensor:
        """Gradient of the misfit of such an image by its pixels."""
        splat = Splat(
            image, table, chosen, self._views, self._parts, self._measurement, self._sums, self._largest[0]
        )
        if self.scene.blurring or max(self._parts) > 1:
            blur = self.gaussians.blur if self.scene.blurring else self._no_blur
            return detected_misfit_gradient(splat, blur, self._grad_blur)
        return misfit_gradient(splat)

    def _of_rays(
        self,
        drawn: tuple[_Drawn, torch.Tensor],
        record: torch.Tensor,
        table: torch.Tensor,
        pixels: torch.Tensor,
    ) -> tuple[torch.Tensor, ...]:
        """Gradients of the misfit by a portion's position, deviation, rotation and weights."""
        moments = rays_backward.sum_moments(record, pixels, len(drawn[0][-1]), self._views)
        return rays_pull_back(*drawn[0], table, self._views, moments)

    def _beside(self) -> AbstractContextManager[Any]:
        """Where the volume's part of a step is made, which needs nothing of that of the rays."""
        return nullcontext()

    def _join(self) -> None:
        """Wait for what is made there."""

    def _ellipsoids(self, drawn: tuple[_Drawn, torch.Tensor]) -> torch.Tensor:
        (position, scale, rotation, _), output = drawn
        return ellipsoids(position, scale, rotation, output, self._box_table, VOXEL_CUTOFF)

    def _voxelised(self, boxed: _Made[torch.Tensor]) -> torch.Tensor:
        """The volume (1, nz, ny, nx) of the rank's planes, of all portions."""
        volume = self._largest.new_zeros((1, *self._box.shape))
        for number in range(len(self._portions)):
            box_forward.splat(boxed(number), 1, self._box, VOXEL_CUTOFF, self._largest[1], volume)
        return volume

    def _slope(self, volume: torch.Tensor, smooth: float) -> torch.Tensor:
        """Gradient of the total variation by the voxels, times ``smooth``."""
        chosen, planes = self.settings, self.scene.box.shape[0]
        return variation_gradient(
            volume,
            self.scene.tv_corners,
            chosen.bone_level,
            smooth,
            self._largest[1],
            planes,
        )

    def _of_volume(
        self, drawn: tuple[_Drawn, torch.Tensor], record: torch.Tensor, slope: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Gradients of the total variation by a portion's position, deviation, rotation and weight."""
        (position, scale, rotation, _), output = drawn
        moments = box_backward.sum_moments(record, slope, self._box, VOXEL_CUTOFF)
        return box_backward.pull_back(position, scale, rotation, output, self._box_table, moments)

    def _none_of_volume(self, number: int) -> tuple[torch.Tensor, ...]:
        """The same where nothing is smoothed."""
        count = self._portions[number].stop - self._portions[number].start
        *of_shape, of_weight = self._not_smoothed
        return (*(zeros[:count] for zeros in of_shape), of_weight[:, :count])


def _kept(gaussians: int, many: int, views: int, device: torch.device) -> int:
    """Of how many of ``many`` portions what a step makes on its way is kept. The result is the same."""
    if device.type == "cpu" or many == 1:
        return many
    needed = gaussians * (_PASSING + _RECORD * views)
    return min(many, int(many * _KEPT * free_bytes(device) / needed))
