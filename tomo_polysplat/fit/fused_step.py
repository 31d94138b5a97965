"""The step of the optimiser as a dozen CUDA kernels of our own, without autograd.

The mathematics are those of `EagerStep`; what changes from step to step reaches the kernels through one small
tensor, so that the same launches do for every step (`graph_step.py` records them once).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import numpy as np
import torch

from tomo_polysplat.fit.adam import EPSILON, new_moments
from tomo_polysplat.fit.feed import feed
from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.fit.shares import Part
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
from tomo_polysplat.kernels.step.triton_activate import activate
from tomo_polysplat.kernels.step.triton_detector import detected_misfit_gradient
from tomo_polysplat.kernels.step.triton_misfit import Measurement, Splat, misfit_gradient
from tomo_polysplat.kernels.step.triton_update import FIRST_DECAY, SECOND_DECAY, Bounds, update, update_shared
from tomo_polysplat.kernels.step.triton_variation import variation_gradient
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.kernels.voxelise import triton_backward as box_backward
from tomo_polysplat.kernels.voxelise import triton_forward as box_forward
from tomo_polysplat.kernels.voxelise.triton_setup import box_table, ellipsoids
from tomo_polysplat.physics.detector_blur import LARGEST_BLUR
from tomo_polysplat.physics.transmission import nodes_on
from tomo_polysplat.render.renderer import VOXEL_CUTOFF

__all__ = ["FusedStep"]

# Numbers of the control tensor, in its order: of the update, and of each view its number and slot, and its geometry.
# Every part begins at 16 bytes whatever the batch: elsewhere the kernels would be compiled once more.
_HEAD, _CHOSEN, _VIEW = 4, 2, 21

# Position, deviation, rotation and weights.
_Drawn = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


class _Seen(NamedTuple):
    """Footprints of Gaussians in some views, and the images of these."""

    record: torch.Tensor
    splat: Splat


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
        # Only the shape of these views counts. All ranks have as many portions.
        most = len(gaussians) if part is None else part.most
        self._portions = portions(fine.select(np.arange(batch)), most)
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
        gaussians, part = self.gaussians, self.part
        _, chosen, table = self._parts_of_control()
        table, chosen = table.view(self._batch, _VIEW), chosen.view(_CHOSEN, self._batch)
        scale, weight, output = activate(
            gaussians.log_scale,
            gaussians.attenuation,
            gaussians.own_material,
            gaussians.shared_material,
            gaussians.group,
            self._curves,
        )
        drawn = (gaussians.position, scale, gaussians.rotation)
        of_volume = self._not_smoothed
        lent: tuple[torch.Tensor, ...] = ()
        if smooth:
            with self._beside():
                voxels = self._voxelised((*drawn, output))
                if part is not None:
                    lent = (part.lent(voxels[1][0]),)
                else:
                    of_volume = self._volume_gradients((*drawn, output), *voxels, smooth)
                    del voxels
        of_rays: tuple[torch.Tensor, ...] = ()
        first = 0
        for views in self._portions:
            seen = self._splatted((*drawn, weight), table, chosen, views, first)
            if part is not None:
                self._join()
                yield (seen.splat.raw, *(lent if not first else ()))
            if part is not None and smooth and not first:
                with self._beside():
                    part.take(lent[0], voxels[1][0])
                    of_volume = self._volume_gradients((*drawn, output), *voxels, smooth)
                    del voxels
            of_portion = self._of_portion((*drawn, weight), seen)
            for total, gradient in zip(of_rays, of_portion):
                total += gradient
            of_rays, first = of_rays or of_portion, first + len(views)
            del seen, of_portion
        self._join()
        self._update((scale, self._curves), of_rays, of_volume)
        if part is not None and self._curves is not None:
            yield (self._grad_shared,)
        self._update_shared()

    def _update(self, drawn, of_rays, of_volume) -> None:
        gaussians, (head, _, _) = self.gaussians, self._parts_of_control()
        state = (self._grad_shared, self.pull, self._rates, head)
        update(
            gaussians.parameters(),
            gaussians.group,
            self.moments,
            drawn,
            of_rays,
            of_volume,
            state,
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

    def _splatted(self, drawn: _Drawn, table, chosen, views: DetectorViews, first: int) -> _Seen:
        """Images of the views from the ``first`` of the step on."""
        cutoff, largest = self.scene.cutoff, self._largest[0]
        table = table[first : first + len(views)]
        record = footprints(*drawn, views, table, cutoff, self._skipped)
        image = rays_forward.splat(record, len(drawn[-1]), views, cutoff, largest)
        measurement = self._measurement
        return _Seen(
            record, Splat(image, table, chosen, views, self._parts, measurement, self._sums, largest, first)
        )

    def _of_portion(self, drawn: _Drawn, seen: _Seen) -> tuple[torch.Tensor, ...]:
        """Gradients of the misfit of such images by position, deviation, rotation and weights."""
        record, splat = seen
        if self.scene.blurring or max(self._parts) > 1:
            blur = self.gaussians.blur if self.scene.blurring else self._no_blur
            pixels = detected_misfit_gradient(splat, blur, self._grad_blur)
        else:
            pixels = misfit_gradient(splat)
        moments = rays_backward.sum_moments(record, pixels, len(drawn[-1]), splat.views)
        return rays_pull_back(*drawn, splat.table, splat.views, moments)

    def _beside(self) -> AbstractContextManager[Any]:
        """Where the volume's part of a step is made, which needs nothing of that of the rays."""
        return nullcontext()

    def _join(self) -> None:
        """Wait for what is made there."""

    def _voxelised(self, drawn: _Drawn) -> tuple[torch.Tensor, torch.Tensor]:
        """Ellipsoids and their volume (1, nz, ny, nx), of the rank's planes."""
        record = ellipsoids(*drawn, self._box_table, VOXEL_CUTOFF)
        return record, box_forward.splat(record, 1, self._box, VOXEL_CUTOFF, self._largest[1])

    def _volume_gradients(
        self, drawn: _Drawn, record: torch.Tensor, volume: torch.Tensor, smooth: float
    ) -> tuple[torch.Tensor, ...]:
        """Gradients of the volume's total variation, likewise, times ``smooth``."""
        chosen, planes = self.settings, self.scene.box.shape[0]
        slope = variation_gradient(
            volume,
            chosen.tv_clip,
            self.scene.tv_corners,
            chosen.bone_level,
            smooth,
            self._largest[1],
            planes,
        )
        moments = box_backward.sum_moments(record, slope, self._box, VOXEL_CUTOFF)
        return box_backward.pull_back(*drawn, self._box_table, moments)
