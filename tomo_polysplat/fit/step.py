"""One step of the optimiser through torch's autograd: on the CPU, and where no CUDA graph can be captured."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Protocol

import numpy as np
import torch

from tomo_polysplat.fit.adam import Adam, Moments
from tomo_polysplat.fit.loss import misfits_of_step, pull_of_roughness
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.fit.shares import Part
from tomo_polysplat.fit.similarity import dissimilarity
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.physics.detector_blur import LARGEST_BLUR
from tomo_polysplat.settings import Settings

__all__ = [
    "EagerStep",
    "Step",
    "held_out_mean",
    "log_scale_bounds",
    "smoothing",
    "step_rates",
    "turning",
]

# Fewer held-out rays in a pass, those of a typical weight, go up and down by chance.
_FEWEST_HELD_OUT = 10.0


class Step(Protocol):
    """A step of the optimiser on Gaussians, which it changes in place.

    Attributes
    ----------
    pull : (n,) tensor
        Lengths of the loss's gradients by position, added up; the caller sets them back to zero.
    moments : dict of name to (exp_avg, exp_avg_sq)
        Adam's memory, to be changed in place only.
    done : int
        Steps made; Adam's bias correction counts with it.
    largest : list of float
        Largest sums so far, to which a GPU's roundings are made; goes with the moments when a run goes on.
    """

    pull: torch.Tensor
    done: int
    largest: list[float]

    @property
    def moments(self) -> Moments: ...

    def __call__(self, views: np.ndarray, share: float) -> None:
        """Step towards the rays of these views and a smooth volume; ``share`` of the run is done, 0 to 1."""

    def set_rates(self, rates: Mapping[str, float]) -> None:
        """Go on with these learning rates, as of the start of a run, by parameter."""

    def read(self) -> tuple[float, float, int]:
        """Since the last call: mean misfit of the fitted rays and of those held out, and pairs skipped.

        The misfit of the held-out rays is NaN where they are too few to say anything.
        """


def step_rates(settings: Settings, spacing: float) -> dict[str, float]:
    """Learning rate of each parameter at the start of a run; ``spacing`` of the seeds."""
    return {
        "position": settings.learning_rate_position * spacing,
        "log_scale": settings.learning_rate_scale,
        "rotation": settings.learning_rate_rotation,
        "attenuation": settings.learning_rate_attenuation,
        "own_material": settings.learning_rate_material,
        "shared_material": settings.learning_rate_shared,
        "blur": settings.learning_rate_blur,
    }


def smoothing(settings: Settings, scene: FitScene, done: int) -> float:
    """Weight of the total variation in the next step, when ``done`` are made; 0 where that step does not take it."""
    return 0.0 if done % scene.tv_every else scene.tv_every * settings.tv_weight


def turning(done: int) -> float:
    """Whether Gaussians may turn in the next step, when ``done`` are made, as a factor: not in the first one.

    Seeds are round, so what would turn them there is rounding, and Adam makes large steps of it.
    """
    return float(done > 0)


def log_scale_bounds(
    scene: FitScene, spacing: float, planar: bool, settings: Settings
) -> tuple[float, float]:
    """Smallest and largest logarithm of a Gaussian's deviation."""
    voxel = float(scene.box.spacing[: 2 if planar else 3].min())
    # Seeds closer than the voxels are there to show what is inside these.
    return math.log(scene.smallest_scale * min(voxel, spacing)), math.log(settings.largest_scale * spacing)


def held_out_mean(total: float, weight: float, typical: float) -> float:
    """Mean misfit of the held-out rays from its sum and their weight; NaN where they are few of a typical one."""
    return total / weight if weight and weight >= _FEWEST_HELD_OUT * typical else math.nan


class EagerStep:
    """The step as torch runs it, operation by operation; see `Step`.

    With a ``part`` the Gaussians are those of one rank of several, whose images and volumes are added up.
    """

    def __init__(self, setup: FitSetup, part: Part | None = None) -> None:
        gaussians, spacing, self.rays, scene, settings = setup
        self.gaussians, self.scene, self.settings = gaussians, scene, settings
        self.part = part
        self.bounds = log_scale_bounds(scene, spacing, gaussians.planar, settings)
        self.pull = torch.zeros_like(gaussians.attenuation)
        self.rates = step_rates(settings, spacing)
        self.adam = Adam(gaussians.parameters())
        self.moments = self.adam.moments
        self.largest: list[float] = []
        self._sums: list[tuple[torch.Tensor | float, ...]] = []
        self._done = 0

    @property
    def done(self) -> int:
        """Steps made."""
        return self._done

    @done.setter
    def done(self, steps: int) -> None:
        self._done = steps
        self.adam.count(steps)

    def __call__(self, views: np.ndarray, share: float) -> None:
        """One step; see `Step`."""
        rates = {name: rate * self.settings.final_rate**share for name, rate in self.rates.items()}
        rates["rotation"] *= turning(self._done)
        chosen, measured, weight, aside = self.rays.batch(views)
        predicted, skipped = self._predict(views, chosen)
        fitted, *held_out = misfits_of_step(predicted, measured, weight, aside, self.settings)
        loss = fitted + self._regularisation(predicted, measured, weight)
        self.adam.forget_gradients()
        # On this thread: autograd's own would be woken and waited for at every step.
        with torch.autograd.set_multithreading_enabled(False):
            loss.backward()
        self._add_up()
        self._hold_materials(share)
        if (moved := self.gaussians.position.grad) is not None:
            self.pull += torch.linalg.vector_norm(moved, dim=1)
        self.adam.step(rates)
        self._done += 1
        self._bound()
        self._sums.append((fitted.detach(), *held_out, skipped))

    def _add_up(self) -> None:
        """Make the gradient of what all Gaussians share that of all ranks; each has the blur's, of the whole images."""
        shared = self.gaussians.shared_material.grad
        if self.part is not None and shared is not None:
            self.part.ranks.sum_(shared)

    def _predict(self, views: np.ndarray, chosen: DetectorViews) -> tuple[torch.Tensor, int]:
        """What the ``views`` of these numbers, which are ``chosen``, would measure, and the pairs skipped."""
        of_all = None if self.part is None else self.part.of_all
        return self.scene.projections(self.gaussians, chosen, of_all=of_all)

    @torch.no_grad()
    def _bound(self) -> None:
        self.gaussians.attenuation.clamp_(min=0.0)
        self.gaussians.own_material.clamp_(self.scene.least_u, 1.0)
        self.gaussians.shared_material.clamp_(self.scene.least_u, 1.0)
        self.gaussians.blur.clamp_(0.0, LARGEST_BLUR)
        self.gaussians.log_scale.clamp_(*self.bounds)

    def set_rates(self, rates: Mapping[str, float]) -> None:
        """Go on with these; see `Step`."""
        self.rates = dict(rates)

    def read(self) -> tuple[float, float, int]:
        """Means since the last call; see `Step`."""
        sums = (float(sum(values)) for values in zip(*self._sums))
        fitted, held_out, weight, skipped = sums
        if self.part is not None:
            (skipped,) = self.part.ranks.total(skipped)
        steps, self._sums = len(self._sums), []
        return fitted / steps, held_out_mean(held_out, weight, self.rays.typical_weight), round(skipped)

    def _regularisation(
        self, predicted: torch.Tensor, measured: torch.Tensor, weight: torch.Tensor
    ) -> torch.Tensor | float:
        """What is added to the misfit: total variation, and the dissimilarity of the projections if asked for."""
        settings = self.settings
        total: torch.Tensor | float = 0.0
        if weight_now := smoothing(settings, self.scene, self._done):
            total = total + pull_of_roughness(self.gaussians, self.scene, settings, weight_now, self.part)
        if settings.ssim_weight:
            total = total + settings.ssim_weight * dissimilarity(predicted, measured, weight)
        return total

    def _hold_materials(self, share: float) -> None:
        """Keep the soft matter's number, and for a while the metals': while edges are blurred they would drift.

        A little cupping and a little hardening look alike, so a soft number that is free trades one for the
        other; held at the first curve the two stay apart.
        """
        gradient = self.gaussians.shared_material.grad
        if gradient is not None:
            gradient[: 1 if share >= self.settings.material_from else None] = 0.0
