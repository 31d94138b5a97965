"""The step of the optimiser as a dozen CUDA kernels of our own, without autograd.

The mathematics are those of `EagerStep`; what changes from step to step reaches the kernels through one small
tensor, so that the same launches do for every step (`graph_step.py` records them once).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch

from tomo_polysplat.fit.adam import EPSILON, new_moments
from tomo_polysplat.fit.feed import feed
from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.fit.step import (
    held_out_mean,
    log_scale_bounds,
    smoothing,
    step_rates,
    turning,
)
from tomo_polysplat.kernels.portions import portions
from tomo_polysplat.kernels.project import triton_backward as rays_backward
from tomo_polysplat.kernels.project import triton_forward as rays_forward
from tomo_polysplat.kernels.project.triton_pull_back import pull_back as rays_pull_back
from tomo_polysplat.kernels.project.triton_setup import footprints
from tomo_polysplat.kernels.step.faint import HALO
from tomo_polysplat.kernels.step.triton_activate import activate
from tomo_polysplat.kernels.step.triton_detector import detected_misfit_gradient
from tomo_polysplat.kernels.step.triton_misfit import Measurement, Splat, misfit_gradient
from tomo_polysplat.kernels.step.triton_update import FIRST_DECAY, SECOND_DECAY, Bounds, update
from tomo_polysplat.kernels.step.triton_variation import variation_gradient
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.kernels.voxelise import triton_backward as box_backward
from tomo_polysplat.kernels.voxelise import triton_forward as box_forward
from tomo_polysplat.kernels.voxelise.triton_setup import box_table, ellipsoids
from tomo_polysplat.physics.detector_blur import LARGEST_BLUR
from tomo_polysplat.physics.transmission import nodes_on
from tomo_polysplat.ranks import ALONE, Ranks
from tomo_polysplat.render.renderer import VOXEL_CUTOFF

__all__ = ["FusedStep", "Gradients"]

# Numbers of the control tensor, in its order: of the update, and of each view its number and slot, and its geometry.
# Every part begins at 16 bytes whatever the batch: elsewhere the kernels would be compiled once more.
_HEAD, _CHOSEN, _VIEW = 4, 2, 21

# Position, deviation, rotation and weights.
_Drawn = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


class Gradients(NamedTuple):
    """Deviations as they are drawn, and gradients by position, deviation, rotation and weights."""

    scale: torch.Tensor
    of_rays: tuple[torch.Tensor, ...]
    of_volume: tuple[torch.Tensor, ...]


class FusedStep:
    """The step kernel by kernel; see `fit.step.Step`.

    Parameters
    ----------
    setup : FitSetup
    batch : int
        Views of a step.
    ranks : Ranks
        Of several each takes its part of the views and of the volume; they add up their gradients.
    """

    # What differs between scenes is set up once, for kernels that are given addresses.
    def __init__(self, setup: FitSetup, batch: int, ranks: Ranks = ALONE) -> None:
        gaussians, spacing, rays, scene, settings = setup
        self.gaussians, self.rays, self.scene, self.settings = gaussians, rays, scene, settings
        self.done, self._unread, self.ranks = 0, 0, ranks
        self._batch, self._mine = batch, ranks.mine(batch)
        of_mine = len(range(batch)[self._mine])
        parameters, device = gaussians.parameters(), gaussians.position.device
        self.pull, self.moments = torch.zeros_like(gaussians.attenuation), new_moments(parameters)
        self.feed = feed(rays.projections, rays.target, max(of_mine, 1))
        rates = step_rates(settings, spacing)
        self._rates = torch.tensor([rates[k] for k in parameters], dtype=torch.float32, device=device)
        bounds = log_scale_bounds(scene, spacing, gaussians.planar, settings)
        self._bounds = Bounds(bounds, (scene.least_u, 1.0), LARGEST_BLUR, EPSILON)
        fine = scene.fine(rays.views)
        self._table = fine.host_table()
        # Only the shape of these views counts.
        self._portions = portions(fine.select(np.arange(of_mine)), len(gaussians)) if of_mine else []
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
        self._planes = ranks.mine(scene.box.shape[0])
        # With the planes beside them, which their differences and what counts as faint need.
        first, end = self._planes.start - HALO, self._planes.stop + HALO
        self._slab = slice(max(first, 0), min(end, scene.box.shape[0]))
        depth = self._slab.stop - self._slab.start
        self._box = scene.box.part((self._slab.start, 0, 0), (depth, *scene.box.shape[1:]))
        self._box_table = box_table(self._box, device)
        self._not_smoothed = tuple(
            torch.zeros(shape, device=device) for shape in ((len(gaussians), 3),) * 2 + ((len(gaussians), 4),)
        ) + (torch.zeros((1, len(gaussians)), device=device),)

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
        corner = settings.huber_corner * settings.model_error if settings.loss == "huber" else 0.0
        nodes = None
        if scene.quadrature is not None:
            nodes = nodes_on(scene.quadrature, torch.float32, rays.target)
        return Measurement(
            self.feed.projections,
            rays.totals,
            rays.noise,
            rays.threshold,
            corner,
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
        fitted, held_out, weight, skipped = self.ranks.total(*sums)
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
        slots = np.zeros(len(views), int)
        slots[self._mine] = self.feed.place(views[self._mine])
        return np.concatenate([head, views, slots, self._table[views].ravel()])

    def _enqueue(self, smooth: float) -> None:
        """All kernels of a step that smooths with this weight; what else they read of it is in the control tensor."""
        made = self._gradients(smooth)
        self._add_up(made)
        self._update(made)

    def _parts_of_control(self) -> tuple[torch.Tensor, ...]:
        return self._control.split([_HEAD, self._batch * _CHOSEN, self._batch * _VIEW])

    def _gradients(self, smooth: float) -> Gradients:
        """Those of this rank's part."""
        gaussians = self.gaussians
        _, chosen, table = self._parts_of_control()
        scale, weight, output = activate(
            gaussians.log_scale,
            gaussians.attenuation,
            gaussians.own_material,
            gaussians.shared_material,
            gaussians.group,
            self._curves,
        )
        drawn = (gaussians.position, scale, gaussians.rotation)
        smoothed = smooth and self._planes.start < self._planes.stop
        of_volume = self._volume_gradients(*drawn, output, smooth) if smoothed else self._not_smoothed
        if smooth and not smoothed:  # to which the other ranks' are added
            of_volume = tuple(tensor.clone() for tensor in of_volume)
        of_rays = self._of_rays(
            (*drawn, weight), table.view(self._batch, _VIEW), chosen.view(_CHOSEN, self._batch)
        )
        if smoothed:
            self._join()
        return Gradients(scale, of_rays, of_volume)

    def _add_up(self, made: Gradients) -> None:
        """Make the gradients those of all ranks."""
        if self.ranks.count > 1:
            smoothed = made.of_volume is not self._not_smoothed
            self.ranks.sum_(*made.of_rays, *(made.of_volume if smoothed else ()))
            if self.scene.blurring:
                self.ranks.sum_(self._grad_blur)

    def _update(self, made: Gradients) -> None:
        gaussians, (head, _, _) = self.gaussians, self._parts_of_control()
        update(
            gaussians.parameters(),
            gaussians.group,
            self.moments,
            (made.scale, self._curves),
            made.of_rays,
            made.of_volume,
            (self._grad_shared, self._grad_blur, self.pull, self._rates, head),
            self._bounds,
            self.scene.blurring,
        )

    def _of_rays(self, drawn: _Drawn, table, chosen) -> tuple[torch.Tensor, ...]:
        """Gradients of the misfit by position, deviation, rotation and weights, a portion of the views at a time."""
        if not self._portions:
            return tuple(torch.zeros_like(tensor) for tensor in drawn)
        totals: tuple[torch.Tensor, ...] = ()
        first = self._mine.start
        for views in self._portions:
            of_portion = self._of_portion(drawn, table, chosen, views, first)
            for total, gradient in zip(totals, of_portion):
                total += gradient
            totals, first = totals or of_portion, first + len(views)
        return totals

    def _of_portion(
        self, drawn: _Drawn, table, chosen, views: DetectorViews, first: int
    ) -> tuple[torch.Tensor, ...]:
        """The same of the views from the ``first`` of the step on."""
        cutoff, channels, largest = self.scene.cutoff, len(drawn[-1]), self._largest[0]
        table = table[first : first + len(views)]
        record = footprints(*drawn, views, table, cutoff, self._skipped)
        image = rays_forward.splat(record, channels, views, cutoff, largest)
        seen = Splat(image, table, chosen, views, self._parts, self._measurement, self._sums, largest, first)
        if self.scene.blurring or max(self._parts) > 1:
            blur = self.gaussians.blur if self.scene.blurring else self._no_blur
            pixels = detected_misfit_gradient(seen, blur, self._grad_blur)
        else:
            pixels = misfit_gradient(seen)
        moments = rays_backward.sum_moments(record, pixels, channels, views)
        return rays_pull_back(*drawn, table, views, moments)

    def _join(self) -> None:
        """Wait for the volume's gradients, where they are made beside those of the rays."""

    def _volume_gradients(self, position, scale, rotation, output, smooth) -> tuple[torch.Tensor, ...]:
        """Gradients of the volume's total variation, likewise, times ``smooth``."""
        drawn, box, table = (position, scale, rotation, output), self._box, self._box_table
        record = ellipsoids(*drawn, table, VOXEL_CUTOFF)
        volume = box_forward.splat(record, 1, box, VOXEL_CUTOFF, self._largest[1])
        chosen = self.settings
        slope = variation_gradient(
            volume,
            chosen.tv_clip,
            self.scene.tv_corners,
            chosen.bone_level,
            smooth,
            self._largest[1],
            self.scene.box.shape[0],
        )
        # Each plane's slope is told by the rank that it belongs to.
        slope[:, : self._planes.start - self._slab.start] = 0.0
        slope[:, self._planes.stop - self._slab.start :] = 0.0
        moments = box_backward.sum_moments(record, slope, box, VOXEL_CUTOFF)
        return box_backward.pull_back(*drawn, table, moments)
