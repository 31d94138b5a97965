"""What a scene needs, decided from the data before the fit, with the reasons."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from tomo_polysplat.fit.depth import optical_depth
from tomo_polysplat.fit.plan_seeds import cells, seed_spacing, smallest_scale
from tomo_polysplat.fit.reference import SoftReference, lightness, soft_reference
from tomo_polysplat.fit.stopping import patience_of
from tomo_polysplat.fit.texture import tv_corners
from tomo_polysplat.fit.unit_check import doubt_lengths
from tomo_polysplat.physics.detector_blur import describe_blur
from tomo_polysplat.settings import Settings

if TYPE_CHECKING:
    from tomo_polysplat.fit.problem import Problem

__all__ = ["AVERAGED_RAYS", "Plan", "make_plan"]

# Fewer steps than this leave edges blurred; more of one view each are noisier than fewer of several. A GPU, whose
# steps cost little, makes more of them. The few rays of a planar view do with fewer steps (five fan-beam slices: 38.0
# dB with 4 views a step, 38.3 with 8).
_STEPS, _STEPS_PLANAR = 360, 300
_MOST_VIEWS, _MOST_VIEWS_PLANAR = {"cpu": 12, "cuda": 6}, 8
# An object whose main matter is lighter than so many soft references, foam or down, has its level of nothing lowered.
_LIGHT = 0.15
# Rays a pixel and axis where the light is averaged: with three pins of 36^3 are no better than with two (45.4 and 48.4
# dB everywhere).
AVERAGED_RAYS = 2
# Passes of a run that nobody has given a length, and of slices. By 15 passes instead of 10 six scenes of 48^3 gain 0.6
# dB without metal in the mean and 0.2 everywhere, and take a fifth more time, those of 128^3 on an H200 0.4 and 0.2 in
# a sixth more; with 20 passes 0.1 dB more in a sixth more time yet.
_PASSES, _PASSES_PLANAR = 15.0, 10.0
# Of fewer views than these a run makes more passes, as many views in all up to so many times: 12 to 36 views, six
# volumes of 36^3, came to 32.0 / 44.0 dB in 3.7 s by 10 passes, and to 32.9 / 44.5 in 6.5 s so (33.2 / 44.6 in 8.2 s
# by 40).
_MANY_VIEWS, _MOST_TIMES = 45, 3.0
# Steps of a small cloud cost little: with fewer seeds in matter than the second number a run makes more of them, by up
# to the first, and a third as many more passes. Ten volumes of 26^3 to 34^3, steps of two views: 33.3 / 39.4 dB in 15
# passes, 33.5 / 39.8 in 20, for a fifth more time; steps of one view in 15 passes 33.4 / 39.7, for a third more. Of
# 36^3 to 40^3, four with 10 000 to 11 000 seeds gain 0.3 / 1.6 dB for a third more time, two with more seeds nothing.
# Slices, of which larger ones gain, too, are made longer in passes as much (128^2, twice the passes: steel wires 26.4
# to 28.3, soft tissue 44.2 to 45.4), but not the fan-beam slices (22 000 seeds, 1.5 times the passes: 39.6 to 39.6,
# 37.7 to 37.5): theirs go with the root.
_LONGER, _LONGER_PLANAR = (2.0, 18_000), (2.0, 36_000)
# Voxels take 40 % of a step. Smoothed at every other step, twice as much, volumes are the same in 10 to 30 % less time
# (twelve scans of 32^3 to 64^3 on a CPU: -0.03 dB without metal and 0.0 everywhere in the mean, -0.17 at most; seven
# of 64^3 and 128^3 on an H200: 0.0), and larger ones, which would take most of it, less often yet. Too seldom, in a
# CPU's 300 steps or a GPU's 900, they are smoothed by leaps, which upset the optimiser's sense of scale (pins, 64^3,
# 300 steps: 35.7, 35.6 and 35.1 dB at every second, fourth and eighth). In slices, where they take less, a casting of
# 128^2 lost 0.1 dB by every other step.
_TV_EVERY, _TV_RARELY = 2, {"cpu": 4, "cuda": 8}
# Voxels that a step can smooth while it does the rest.
_TV_VOXELS, _TV_VOXELS_PLANAR = {"cpu": 140_000, "cuda": 4_200_000}, 65_536


@dataclass
class Plan:
    """The decisions.

    Attributes
    ----------
    reference, first, soft_u : float
        Soft reference, that of the first material, and the reference's material number; see ``fit.reference``: g/cm3,
        or 1/unit when monochromatic.
    depth : float
        -log(I/I0) of a typical ray through the soft matter; see ``fit.depth``.
    support_level : float
        What the start holds less of, in soft references, is empty.
    spacing : float
        Distance of the seeds in voxels.
    finer : float
        Share of the Gaussians that is seeded twice as finely as the rest; see ``model.seed``.
    smallest_scale : float
        Smallest deviation of a Gaussian, in voxels, or in spacings where these are closer.
    views_per_step : int
    passes : float
        Times that every view is used.
    tv_every : int
        In every how many steps the volume's total variation is taken.
    tv_corners : pair of float
        Difference of neighbouring voxels, in soft references, up to which it counts in full: of soft matter, and where
        one of the two is bone-like or denser.
    curves : int
        Material curves of the model: three, or the first alone, as for a monochromatic one.
    pixel_rays : int
        Rays a pixel and axis over which the light is averaged; 0 until `fit.pixel_averaging` has told.
    fat : bool or None
        Whether light soft matter is fat; None until `fit.fat` has told.
    sharp : bool
        Whether seeds are thin across edges however close they are; `fit.sharpness` tells it by short fits.
    growth : float
        So many times as many Gaussians as seeds there may be in the end; `fit.detail` tells it after a short fit.
    blurred : bool
        Whether rays are seen through the detector's blur; see ``physics.detector_blur``.
    tv_factor : float
        What the settings' weight of the total variation is multiplied by; see `fit.smoothing`.
    dense : float
        Of dense matter with soft matter in it, which is no metal; see ``fit.reference``.
    reasons : dict
        Decision by decision, what was chosen and why; it becomes ``Result.plan``.
    """

    reference: float
    first: float
    soft_u: float
    depth: float
    support_level: float
    spacing: float
    finer: float
    smallest_scale: float
    views_per_step: int
    passes: float
    tv_every: int
    tv_corners: tuple[float, float]
    curves: int
    blurred: bool
    pixel_rays: int = 0
    fat: bool | None = None
    sharp: bool = False
    growth: float = 1.0
    tv_factor: float = 1.0
    dense: float = 0.0
    reasons: dict[str, Any] = field(default_factory=dict)

    def adapted(self, settings: Settings) -> Settings:
        """The settings for this object: levels and material numbers (``fit.reference``), and how much is smoothed."""
        settings = SoftReference(self.reference, self.first, self.soft_u, dense=self.dense).adapted(settings)
        weight = self.tv_factor * settings.tv_weight
        return replace(settings, tv_weight=weight, support_level=self.support_level, growth=self.growth)


def make_plan(start: np.ndarray | torch.Tensor, problem: Problem, settings: Settings, device: str) -> Plan:
    """Decide from the start volume and the geometry.

    Parameters
    ----------
    start : (nz, ny, nx) array or tensor
        First reconstruction in the solver's units (``fit.first_volume``).
    problem : Problem
    settings : Settings
        Zero stands for "decide", anything else is taken as it is.
    device : "cpu" or "cuda"
    """
    matter = soft_reference(start, problem, settings, problem.solid)
    reference, first = matter.value, matter.first
    relative = torch.as_tensor(start) / (reference * problem.depth)
    light = lightness(relative, matter.adapted(settings).metal_level)
    level = settings.support_level * min(1.0, light / _LIGHT)
    least = level * reference * problem.depth
    support = int((start > least).sum())
    spacing, finer, because = seed_spacing(
        start, least, support, problem, settings, device, settings.bone_level * reference * problem.depth
    )
    smallest, thin = smallest_scale(spacing, problem, settings)
    longer = _longer(cells(support, problem) / spacing**problem.dimensions, problem.planar)
    passes, views, reason = _length(problem, settings, device, longer)
    every = settings.tv_every or _tv_every(math.prod(start.shape), problem.planar, device)
    curves, needed = _curves(start, first * problem.depth, problem.polychromatic, settings)
    blurred, told = _blurred(start, first * problem.depth, settings)
    corners, texture = tv_corners(relative, matter.adapted(settings), problem.agreement, light)
    plan = Plan(
        reference=reference,
        first=first,
        soft_u=matter.number,
        dense=matter.dense,
        depth=optical_depth(relative, level, reference, problem),
        support_level=level,
        spacing=spacing,
        finer=finer,
        smallest_scale=smallest,
        views_per_step=views,
        passes=passes,
        tv_every=every,
        tv_corners=corners,
        curves=curves,
        blurred=blurred,
        pixel_rays=settings.pixel_rays,
        fat={"auto": None, "soft": False, "fat": True}[settings.light],
    )
    unit = "g/cm3" if problem.polychromatic else "per unit of length"
    plan.reasons = {
        "model": "polychromatic: a spectrum was given"
        if problem.polychromatic
        else "monochromatic: no spectrum was given, or one of a single energy",
        "curves": f"{curves}: {needed}",
        "dimensions": "2D Gaussians: one row and one slice in one plane"
        if problem.planar
        else "3D Gaussians: several rows or slices, or rays that leave the plane",
        "soft_reference": f"{reference:.4g} {unit}: {matter.why}",
        "support": f"{support} of {math.prod(start.shape)} voxels hold more than {level:.2g} soft references",
        "seed_spacing_voxels": f"{spacing:.2f}: {because}",
        "smallest_scale": f"{smallest:g} voxels: {thin}",
        "views_per_step": f"{views} of {problem.geometry.views}: {reason}",
        "smoothed": _smoothed(every, settings),
        "texture": texture,
        "detector_blur": told,
        "passes": f"{passes:g} over the views at most, fewer where {settings.held_out:.1%} of the rays, held"
        f" out of the fit, have not improved for {patience_of(settings, passes)}",
    }
    if matter.wrong_unit:
        doubt_lengths(plan.reasons, f"densities are measured by {matter.why}")
    return plan


def _curves(
    start: np.ndarray | torch.Tensor, soft: float, polychromatic: bool, settings: Settings
) -> tuple[int, str]:
    """How many material curves, for a start whose soft reference is ``soft``."""
    if not polychromatic:
        return 1, "there is one energy, and no material to tell by it"
    if settings.curves:
        return settings.curves, "asked for"
    if settings.soft_u:
        return 3, "soft matter has a material number other than 0"
    if settings.light == "fat":
        return 3, "light matter has a material number of its own"
    dense = int((start > settings.bone_level * soft).sum())
    if dense:
        return 3, f"{dense} voxels of the start are denser than {settings.bone_level:g} soft references"
    largest = float(start.max()) / soft if soft else 0.0
    return 1, (
        f"the densest voxel of the start has {largest:.2g} soft references, so that no material number would be free"
    )


def _blurred(start: np.ndarray | torch.Tensor, soft: float, settings: Settings) -> tuple[bool, str]:
    """Whether the detector's blur is modelled: where it is to be fitted, metal must show that edges are sharp."""
    if not settings.learning_rate_blur:
        return settings.blur > 0, describe_blur(settings.blur, fitted=False)
    if bool((start > settings.metal_level * soft).any()):
        return (
            True,
            f"fitted, from a variance of {settings.blur:g} squared pixels on: metal has edges that hold it",
        )
    return False, "none: without metal, a smooth object and a detector that blurs look alike"


def _tv_every(voxels: int, planar: bool, device: str) -> int:
    """In every how many steps a volume is smoothed."""
    at_once = _TV_VOXELS_PLANAR if planar else _TV_VOXELS[device]
    return min(max(-(-voxels // at_once), 1 if planar else _TV_EVERY), _TV_RARELY[device])


def _smoothed(every: int, settings: Settings) -> str:
    when = f"in one step of {every}" if every > 1 else "in every step"
    return f"the volume, {when}: {'asked for' if settings.tv_every else 'what steps have time for'}"


def _longer(seeds: float, planar: bool) -> float:
    """How many times as long the run of a cloud of so many seeds may be."""
    most, many = _LONGER_PLANAR if planar else _LONGER
    ratio = many / max(1.0, seeds)
    return round(min(most, max(1.0, math.sqrt(ratio) if planar else ratio)), 2)


def _length(problem: Problem, settings: Settings, device: str, longer: float) -> tuple[float, int, str]:
    """Passes, views of a step, and why so many of these: as many as leave enough steps."""
    of_scan, planar = problem.geometry.views, problem.planar
    most = _MOST_VIEWS_PLANAR if planar else _MOST_VIEWS[device]
    times = min(max(1.0, _MANY_VIEWS / of_scan), _MOST_TIMES)
    passes = settings.passes or round(times * (_PASSES_PLANAR if planar else _PASSES), 1)
    # A longer run makes more steps and larger ones, by the root of its passes; a shorter one fewer and smaller ones.
    steps = _STEPS_PLANAR if planar else _STEPS * math.sqrt(passes / _PASSES)
    if not settings.passes:
        steps *= longer if times == 1 else 1
        passes *= longer if planar else (2 + longer) / 3
    if settings.views_per_step:
        return passes, min(of_scan, settings.views_per_step), "asked for"
    together = max(1, min(of_scan, most, round(passes * of_scan / steps)))
    return passes, together, f"for about {steps:.0f} steps, and at most {most} views in each"
