"""The forward model of a scan under a plan, and the measured rays that it is compared with."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np
import torch

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.kernels import select
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.beer_lambert import projection
from tomo_polysplat.physics.quadrature import Quadrature
from tomo_polysplat.physics.solids import number_of_solid
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.plan.spectral_model import spectral_model
from tomo_polysplat.render.renderer import detector_views, voxel_box
from tomo_polysplat.scan.noise import RayNoise
from tomo_polysplat.settings import Settings

__all__ = ["all_curves", "rays_of", "scene_of"]

logger = logging.getLogger(__name__)


def scene_of(problem: Problem, plan: Plan, settings: Settings, device: torch.device) -> FitScene:
    """The forward model; what was chosen for it is noted in the plan."""
    kernel, why = select.choose(device, settings.kernel)
    plan.note("kernel", kernel, why)
    quadrature, reference_curve, output_curve, least_u = spectral_model(problem, plan, settings, device)
    # One node of one curve: -log(I/I0) is in proportion to the areal density.
    straight = quadrature is not None and quadrature.attenuation.size == 1
    slope = float(quadrature.attenuation[0, 0]) if quadrature is not None and straight else 1.0
    closed, words = problem.closed(device)
    plan.note("window", "closed" if closed else "open", words)
    return FitScene(
        box=voxel_box(problem.grid, problem.geometry, plan.spacing),
        quadrature=None if straight else quadrature,
        areal_scale=problem.depth * plan.reference * slope,
        reference_curve=reference_curve,
        output_curve=output_curve,
        least_u=least_u,
        kernel=kernel,
        metal_tail=settings.metal_tail,
        blurring=plan.blurred,
        tv_corners=plan.tv_corners,
        closed=closed,
        tv_every=plan.tv_every,
        smallest_scale=plan.smallest_scale,
        pixel_rays=max(plan.pixel_rays, 1),
        light_u=settings.light_u if plan.fat else 0.0,
        solid_number=_solid_number(problem, plan, settings),
        behind=None if straight else _behind(problem, quadrature, device),
    )


def _behind(problem: Problem, quadrature: Quadrature | None, device: torch.device) -> torch.Tensor | None:
    """(2, rows, columns) areal density of each pixel's filter, and P of the nodes through it alone."""
    if problem.filter_map is None or quadrature is None or quadrature.filter is None:
        return None
    areal = problem.filter_map.areal
    alone = projection(areal[None], quadrature.log_weights, quadrature.filter[None])
    return torch.from_numpy(np.stack([areal, alone]).astype(np.float32)).to(device)


def rays_of(problem: Problem, plan: Plan, settings: Settings, device: torch.device) -> Rays:
    """The measured rays on the device."""
    noise = RayNoise() if settings.loss == "l1" else problem.noise(device)
    photons, why = noise.photons, "from the scatter of neighbouring pixels"
    if noise.deviation:
        why = f"the noise of -log(I/I0) does not grow with depth: a deviation of {noise.deviation:.2g}, {why}"
    plan.note("photons_per_ray", photons, why)
    views = detector_views(problem.geometry, problem.planar)
    values = problem.measured(device)
    target = None if values.device.type == device.type else device
    dimmed = problem.dimmed(device)
    given = settings.model_error, settings.held_out, target, dimmed
    return Rays(values, views, photons, *given, deviation=noise.deviation)


def _solid_number(
    problem: Problem, plan: Plan, settings: Settings
) -> Callable[[np.ndarray], np.ndarray] | None:
    """Numbers of solids by attenuation at the volume's energy, for curves that they are known for."""
    other = problem.materials != Materials() or settings.metal_u != Settings().metal_u
    if problem.spectrum is None or other:
        return None
    energy = problem.spectrum.effective_energy
    return lambda levels: number_of_solid(plan.reference * levels, energy)


def all_curves(problem: Problem, basis: np.ndarray, plan: Plan, dense: float, metal: float) -> np.ndarray:
    """(3, nz, ny, nx) densities of the material curves from those of the model, which may lack two.

    Matter of more than ``dense`` soft references, which the start did not show, is told in the log and the plan. Only
    from ``metal`` on it is a warning: two skulls have 0.1 and 0.3 dB less with material numbers of their own.
    """
    if problem.materials is None or len(basis) > 1:
        return basis
    found = float(basis.max(initial=0.0)) / plan.reference
    if found > dense:
        words = f"the fit found {found:.2g} soft references where the start had none above {dense:g}"
        words += ": it counts as dense soft matter"
        plan.note("dense_matter", found, words)
        if found > metal:
            logger.warning("Metal that the start does not show: %s.", words)
        else:
            logger.info("Dense matter: %s.", words)
    # What is never written to takes no memory.
    curves = np.zeros((3, *basis.shape[1:]), np.float32)
    curves[0] = basis[0]
    return curves
